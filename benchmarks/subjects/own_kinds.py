"""Networks of kinds that ``transformers`` has no plain configuration for."""

import itertools

import torch
from torch import Tensor, nn

from benchmarks.subjects.resnet50 import RESIDUAL_SCALE, Classifier

# Howard et al. 2019, table 1 (MobileNetV3-Large):
# kernel, expansion, out, squeeze-and-excite, hard-swish, stride
LARGE = (
    (3, 16, 16, False, False, 1),
    (3, 64, 24, False, False, 2),
    (3, 72, 24, False, False, 1),
    (5, 72, 40, True, False, 2),
    (5, 120, 40, True, False, 1),
    (5, 120, 40, True, False, 1),
    (3, 240, 80, False, True, 2),
    (3, 200, 80, False, True, 1),
    (3, 184, 80, False, True, 1),
    (3, 184, 80, False, True, 1),
    (3, 480, 112, True, True, 1),
    (3, 672, 112, True, True, 1),
    (5, 672, 160, True, True, 2),
    (5, 960, 160, True, True, 1),
    (5, 960, 160, True, True, 1),
)


def resnet50() -> nn.Module:
    """Return ResNet-50 with a classifier (:mod:`benchmarks.subjects.resnet50`)."""
    network = Classifier()
    for name, layer in network.named_modules():
        if isinstance(layer, nn.Conv2d):
            nn.init.kaiming_normal_(layer.weight, mode="fan_out", nonlinearity="relu")
        elif isinstance(layer, nn.BatchNorm2d) and name.endswith("bn3"):
            layer.weight.data *= RESIDUAL_SCALE
    return network


def convolution(
    inputs: int, outputs: int, kernel: int, stride: int, act: nn.Module, groups: int = 1
) -> nn.Sequential:
    """Return a convolution without bias, its normalisation and its activation."""
    conv = nn.Conv2d(
        inputs, outputs, kernel, stride, kernel // 2, groups=groups, bias=False
    )
    return nn.Sequential(conv, nn.BatchNorm2d(outputs), act)


class SqueezeExcite(nn.Module):
    """Scale channels by what their means say."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        middle = channels // 4
        self.layers = nn.Sequential(
            nn.AdaptiveAvgPool2d(1),
            nn.Conv2d(channels, middle, 1),
            nn.ReLU(),
            nn.Conv2d(middle, channels, 1),
            nn.Hardsigmoid(),
        )

    def forward(self, x: Tensor) -> Tensor:
        scaled: Tensor = x * self.layers(x)
        return scaled


class Inverted(nn.Module):
    """An inverted residual block."""

    def __init__(self, inputs: int, row: tuple[int, int, int, bool, bool, int]) -> None:
        super().__init__()
        kernel, wide, outputs, excite, swish, stride = row
        act = nn.Hardswish() if swish else nn.ReLU()
        self.adds = stride == 1 and inputs == outputs
        self.layers = nn.Sequential(
            convolution(inputs, wide, 1, 1, act),
            convolution(wide, wide, kernel, stride, act, wide),
            SqueezeExcite(wide) if excite else nn.Identity(),
            convolution(wide, outputs, 1, 1, nn.Identity()),
        )

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.layers(x)
        return x + y if self.adds else y


class MobileNetV3(nn.Module):
    """MobileNetV3-Large: 5.5 M parameters."""

    def __init__(self, classes: int = 1000) -> None:
        super().__init__()
        blocks: list[nn.Module] = [convolution(3, 16, 3, 2, nn.Hardswish())]
        inputs = 16
        for row in LARGE:
            blocks.append(Inverted(inputs, row))
            inputs = row[2]
        blocks.append(convolution(inputs, 960, 1, 1, nn.Hardswish()))
        self.features = nn.Sequential(*blocks)
        self.head = nn.Sequential(
            nn.Linear(960, 1280), nn.Hardswish(), nn.Linear(1280, classes)
        )

    def forward(self, x: Tensor) -> Tensor:
        logits: Tensor = self.head(self.features(x).mean((2, 3)))
        return logits


class Recurrent(nn.Module):
    """A text reader: convolutions, then two LSTMs both ways over the columns."""

    def __init__(self) -> None:
        super().__init__()
        relu = nn.ReLU()
        self.features = nn.Sequential(
            convolution(3, 64, 3, 2, relu),
            convolution(64, 128, 3, 2, relu),
            convolution(128, 256, 3, 2, relu),
        )
        self.reader = nn.LSTM(2048, 256, 2, bidirectional=True)
        self.head = nn.Linear(512, 97)

    def forward(self, x: Tensor) -> Tensor:
        columns = self.features(x).flatten(1, 2).permute(2, 0, 1)
        read, _ = self.reader(columns)
        logits: Tensor = self.head(read)
        return logits


class Segmenter(nn.Module):
    """A U of convolutions that takes any batch and any image."""

    def __init__(self) -> None:
        super().__init__()
        relu = nn.ReLU()
        widths = (32, 64, 128, 256)
        self.first = convolution(3, widths[0], 3, 1, relu)
        self.down = nn.ModuleList(
            convolution(a, b, 3, 2, relu) for a, b in itertools.pairwise(widths)
        )
        self.up = nn.ModuleList(
            convolution(a + b, b, 3, 1, relu)
            for a, b in zip(widths[:0:-1], widths[-2::-1], strict=True)
        )
        self.head = nn.Conv2d(widths[0], 19, 1)

    def forward(self, x: Tensor) -> Tensor:
        seen = [self.first(x)]
        for layer in self.down:
            seen.append(layer(seen[-1]))
        y = seen.pop()
        for layer in self.up:
            skip = seen.pop()
            y = nn.functional.interpolate(y, skip.shape[-2:], mode="nearest")
            y = layer(torch.cat((y, skip), 1))
        logits: Tensor = self.head(y)
        return logits
