"""The feature pyramid of VAD-tiny, which has one level."""

from torch import Tensor, nn

from me2e_compress.zoo.vad.config import EMBED

C5_CHANNELS = 2048


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
        self.lateral_convs = nn.ModuleList([ConvModule(C5_CHANNELS, EMBED, 1)])
        self.fpn_convs = nn.ModuleList([ConvModule(EMBED, EMBED, 3)])

    def forward(self, features: Tensor) -> Tensor:
        """Map [N, 2048, h, w] to [N, 256, h, w]."""
        out: Tensor = self.fpn_convs[0](self.lateral_convs[0](features))
        return out
