"""Images to features at strides 4, 8 and 16."""

from torch import Tensor, nn

from me2e_compress.zoo.highway.config import HighwayConfig
from me2e_compress.zoo.highway.layers import Residual, conv_block


class Backbone(nn.Module):
    """A small residual network."""

    def __init__(self, config: HighwayConfig) -> None:
        super().__init__()
        first, second, third, fourth = config.stages
        self.stem = conv_block(3, first, 3, 2)
        self.stage1 = Residual(first, second, 2)
        self.stage2 = nn.Sequential(Residual(second, third, 2), Residual(third, third))
        self.stage3 = nn.Sequential(
            Residual(third, fourth, 2), Residual(fourth, fourth)
        )

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """[B, 3, H, W] to features of strides 4, 8 and 16."""
        fine = self.stage1(self.stem(images))
        middle = self.stage2(fine)
        return fine, middle, self.stage3(middle)


class Neck(nn.Module):
    """Brings the strides together (Lin et al., 2017, without the smoothing)."""

    def __init__(self, config: HighwayConfig) -> None:
        super().__init__()
        _, *widths = config.stages
        self.laterals = nn.ModuleList(
            [nn.Conv2d(width, config.channels, 1) for width in widths]
        )
        self.grow = nn.Upsample(scale_factor=2, mode="nearest")

    def forward(self, features: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """Features to [B, C, H / 4, W / 4] and [B, C, H / 8, W / 8]."""
        fine, middle, coarse = (
            lateral(x) for lateral, x in zip(self.laterals, features, strict=True)
        )
        middle = middle + self.grow(coarse)
        return fine + self.grow(middle), middle
