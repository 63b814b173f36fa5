"""Residual networks, under the parameter names that published weights use."""

from torch import Tensor, nn

BLOCKS = (3, 4, 6, 3)
"""Blocks of the four stages of ResNet-34 and ResNet-50 (He et al. 2016, table 1)."""

STEM = 64
EXPANSION = 4
"""Channels of a bottleneck's output, relative to those inside."""


class Block(nn.Module):
    """Convolutions, each normalised, and the shortcut.

    Two of 3x3, or of a bottleneck 1x1, 3x3 and 1x1; the first of 3x3 is strided.
    """

    def __init__(
        self, channels: int, width: int, stride: int, *, bottleneck: bool
    ) -> None:
        super().__init__()
        kernels = (1, 3, 1) if bottleneck else (3, 3)
        outs = (width, width, EXPANSION * width) if bottleneck else (width, width)
        strided = kernels.index(3)
        size = channels
        for at, (kernel, out) in enumerate(zip(kernels, outs, strict=True)):
            step = stride if at == strided else 1
            conv = nn.Conv2d(size, out, kernel, step, kernel // 2, bias=False)
            self.add_module(f"conv{at + 1}", conv)
            self.add_module(f"bn{at + 1}", nn.BatchNorm2d(out))
            size = out
        self.count = len(kernels)
        self.relu = nn.ReLU()
        self.downsample: nn.Module | None = None
        if stride != 1 or channels != size:
            self.downsample = nn.Sequential(
                nn.Conv2d(channels, size, 1, stride, bias=False), nn.BatchNorm2d(size)
            )

    def forward(self, x: Tensor) -> Tensor:
        """Map [N, C, H, W] to [N, out, H / stride, W / stride]."""
        shortcut = x if self.downsample is None else self.downsample(x)
        for number in range(1, self.count):
            x = self.relu(self._normalised(number, x))
        x = self._normalised(self.count, x) + shortcut
        out: Tensor = self.relu(x)
        return out

    def _normalised(self, number: int, x: Tensor) -> Tensor:
        conv = self.get_submodule(f"conv{number}")
        normalised: Tensor = self.get_submodule(f"bn{number}")(conv(x))
        return normalised


class ResNet(nn.Module):
    """Maps images to the feature maps of all stages; each stage doubles ``width``."""

    def __init__(self, width: int = STEM, *, bottleneck: bool, inputs: int = 3) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, width, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.relu = nn.ReLU()
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        expansion = EXPANSION if bottleneck else 1
        widths = tuple(width * 2**stage for stage in range(len(BLOCKS)))
        self.channels = tuple(expansion * each for each in widths)
        channels = width
        for number, count in enumerate(BLOCKS, start=1):
            stage = nn.Sequential()
            for index in range(count):
                stride = 2 if index == 0 and number > 1 else 1
                inner = widths[number - 1]
                stage.append(Block(channels, inner, stride, bottleneck=bottleneck))
                channels = self.channels[number - 1]
            self.add_module(f"layer{number}", stage)

    def stem(self, images: Tensor) -> Tensor:
        """Map [N, C, H, W] to [N, width, H / 4, W / 4]."""
        out: Tensor = self.maxpool(self.relu(self.bn1(self.conv1(images))))
        return out

    def stages(self, images: Tensor) -> list[Tensor]:
        """Map [N, 3, H, W] to C2, C3 and so on, of strides 4, 8 and so on."""
        x = self.stem(images)
        maps: list[Tensor] = []
        for number in range(1, len(self.channels) + 1):
            x = self.get_submodule(f"layer{number}")(x)
            maps.append(x)
        return maps


class ResNet50(ResNet):
    """Maps images to the C5 feature map."""

    def __init__(self, width: int = STEM) -> None:
        super().__init__(width, bottleneck=True)

    def forward(self, images: Tensor) -> Tensor:
        """Map [N, 3, H, W] to [N, 32 * width, H / 32, W / 32]."""
        return self.stages(images)[-1]
