"""ResNet-50, of which VAD-tiny uses the last stage, and its one-level pyramid."""

from torch import Tensor, nn

from me2e_compress.zoo.vad.config import EMBED

STAGES = ((64, 3, 1), (128, 4, 2), (256, 6, 2), (512, 3, 2))
"""Width, blocks and stride of the four stages (He et al. 2016, table 1)."""

EXPANSION = 4
OUT_CHANNELS = 512 * EXPANSION


class Bottleneck(nn.Module):
    """1x1, 3x3 (strided), 1x1, and the shortcut."""

    def __init__(self, channels: int, width: int, stride: int) -> None:
        super().__init__()
        out = width * EXPANSION
        self.conv1 = nn.Conv2d(channels, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, out, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(out)
        self.relu = nn.ReLU()
        self.downsample: nn.Module | None = None
        if stride != 1 or channels != out:
            self.downsample = nn.Sequential(
                nn.Conv2d(channels, out, 1, stride, bias=False), nn.BatchNorm2d(out)
            )

    def forward(self, x: Tensor) -> Tensor:
        """Map [N, C, H, W] to [N, 4 * width, H / stride, W / stride]."""
        shortcut = x if self.downsample is None else self.downsample(x)
        x = self.relu(self.bn1(self.conv1(x)))
        x = self.relu(self.bn2(self.conv2(x)))
        x = self.bn3(self.conv3(x)) + shortcut
        out: Tensor = self.relu(x)
        return out


class ResNet50(nn.Module):
    """Images to the C5 feature map."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.relu = nn.ReLU()
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        channels = 64
        for number, (width, blocks, stride) in enumerate(STAGES, start=1):
            stage = nn.Sequential()
            for block in range(blocks):
                stage.append(Bottleneck(channels, width, stride if block == 0 else 1))
                channels = width * EXPANSION
            self.add_module(f"layer{number}", stage)

    def forward(self, images: Tensor) -> Tensor:
        """Map [N, 3, H, W] to [N, 2048, H / 32, W / 32]."""
        x = self.maxpool(self.relu(self.bn1(self.conv1(images))))
        for number in range(1, len(STAGES) + 1):
            x = self.get_submodule(f"layer{number}")(x)
        out: Tensor = x
        return out


class ConvModule(nn.Module):
    """A convolution under the name that the published weights use."""

    def __init__(self, channels: int, out: int, kernel: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, out, kernel, padding=kernel // 2)

    def forward(self, x: Tensor) -> Tensor:
        """Map [N, C, H, W] to [N, out, H, W]."""
        out: Tensor = self.conv(x)
        return out


class FeaturePyramid(nn.Module):
    """C5 to 256 channels."""

    def __init__(self) -> None:
        super().__init__()
        self.lateral_convs = nn.ModuleList([ConvModule(OUT_CHANNELS, EMBED, 1)])
        self.fpn_convs = nn.ModuleList([ConvModule(EMBED, EMBED, 3)])

    def forward(self, features: Tensor) -> Tensor:
        """Map [N, 2048, h, w] to [N, 256, h, w]."""
        out: Tensor = self.fpn_convs[0](self.lateral_convs[0](features))
        return out
