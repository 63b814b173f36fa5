"""Residual networks, under the parameter names that published weights use."""

from collections.abc import Sequence

from torch import Tensor, nn

BLOCKS = (3, 4, 6, 3)
"""Blocks of the four stages of ResNet-34 and ResNet-50 (He et al. 2016, table 1)."""

STEM = 64


class BasicBlock(nn.Module):
    """3x3 (strided) and 3x3 convolutions, and the shortcut."""

    expansion = 1

    def __init__(self, channels: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, width, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.relu = nn.ReLU()
        self.downsample = _shortcut(channels, width, stride)

    def forward(self, x: Tensor) -> Tensor:
        """Map [N, C, H, W] to [N, width, H / stride, W / stride]."""
        shortcut = x if self.downsample is None else self.downsample(x)
        x = self.relu(self.bn1(self.conv1(x)))
        x = self.bn2(self.conv2(x)) + shortcut
        out: Tensor = self.relu(x)
        return out


class Bottleneck(nn.Module):
    """1x1, 3x3 (strided) and 1x1 convolutions, and the shortcut."""

    expansion = 4

    def __init__(self, channels: int, width: int, stride: int) -> None:
        super().__init__()
        out = width * self.expansion
        self.conv1 = nn.Conv2d(channels, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, out, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(out)
        self.relu = nn.ReLU()
        self.downsample = _shortcut(channels, out, stride)

    def forward(self, x: Tensor) -> Tensor:
        """Map [N, C, H, W] to [N, 4 * width, H / stride, W / stride]."""
        shortcut = x if self.downsample is None else self.downsample(x)
        x = self.relu(self.bn1(self.conv1(x)))
        x = self.relu(self.bn2(self.conv2(x)))
        x = self.bn3(self.conv3(x)) + shortcut
        out: Tensor = self.relu(x)
        return out


def _shortcut(channels: int, out: int, stride: int) -> nn.Module | None:
    if stride == 1 and channels == out:
        return None
    return nn.Sequential(
        nn.Conv2d(channels, out, 1, stride, bias=False), nn.BatchNorm2d(out)
    )


class ResNet(nn.Module):
    """Maps images to the feature maps of all stages; each stage doubles ``width``."""

    def __init__(
        self,
        block: type[BasicBlock | Bottleneck],
        blocks: Sequence[int],
        width: int = STEM,
    ) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, width, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.relu = nn.ReLU()
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        self.channels = tuple(
            block.expansion * width * 2**stage for stage in range(len(blocks))
        )
        channels = width
        for number, count in enumerate(blocks, start=1):
            stage = nn.Sequential()
            for index in range(count):
                stride = 2 if index == 0 and number > 1 else 1
                stage.append(block(channels, width * 2 ** (number - 1), stride))
                channels = self.channels[number - 1]
            self.add_module(f"layer{number}", stage)

    def stages(self, images: Tensor) -> list[Tensor]:
        """Map [N, 3, H, W] to C2, C3 and so on, of strides 4, 8 and so on."""
        x = self.maxpool(self.relu(self.bn1(self.conv1(images))))
        maps: list[Tensor] = []
        for number in range(1, len(self.channels) + 1):
            x = self.get_submodule(f"layer{number}")(x)
            maps.append(x)
        return maps


class ResNet50(ResNet):
    """Maps images to the C5 feature map."""

    def __init__(self, width: int = STEM) -> None:
        super().__init__(Bottleneck, BLOCKS, width)

    def forward(self, images: Tensor) -> Tensor:
        """Map [N, 3, H, W] to [N, 32 * width, H / 32, W / 32]."""
        return self.stages(images)[-1]
