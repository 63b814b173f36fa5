"""What is decoded of the strip, and of the bird's eye view: pictures and boxes."""

from torch import Tensor, nn
from torch.nn import functional

from models.lead.config import (
    BEV_CLASSES,
    BOX_CLASSES,
    SEMANTIC_CLASSES,
    YAW_BINS,
    LeadConfig,
)

COARSE, FINE = 8, 4
"""How often the strip's last map is enlarged: together its stride."""

HEADS = {
    "heatmap_head": BOX_CLASSES,
    "wh_head": 2,
    "offset_head": 2,
    "yaw_class_head": YAW_BINS,
    "yaw_res_head": 1,
    "velocity_head": 1,
}
"""Channels of each head of boxes."""


class PerspectiveDecoder(nn.Module):
    """Maps the strip's last map to classes of its pixels."""

    def __init__(self, channels: int, config: LeadConfig) -> None:
        super().__init__()
        coarse, middle, fine = config.semantic
        self.deconv1 = _convolutions(channels, coarse, middle)
        self.deconv2 = _convolutions(middle, fine, fine)
        self.deconv3 = _convolutions(fine, fine, SEMANTIC_CLASSES)[:-1]

    def forward(self, image: Tensor) -> Tensor:
        """Map [1, 512, 12, 36] to logits [1, 10, 384, 1152]."""
        x = self.deconv1(image)
        x = functional.interpolate(x, scale_factor=COARSE, mode="bilinear")
        x = self.deconv2(x)
        x = functional.interpolate(x, scale_factor=FINE, mode="bilinear")
        out: Tensor = self.deconv3(x)
        return out


def _convolutions(*channels: int) -> nn.Sequential:
    """Build two convolutions of 3 x 3, each with a ReLU."""
    before, between, after = channels
    return nn.Sequential(
        nn.Conv2d(before, between, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(between, after, 3, padding=1),
        nn.ReLU(),
    )


class BevDecoder(nn.Module):
    """Maps the bird's eye view to classes of the raster's cells."""

    def __init__(self, config: LeadConfig) -> None:
        super().__init__()
        self.net = nn.Sequential(
            nn.Conv2d(config.features, config.features, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(config.features, BEV_CLASSES, 1, bias=False),
            nn.Upsample(size=config.raster_hw, mode="bilinear"),
        )

    def forward(self, features: Tensor) -> Tensor:
        """Map [1, 64, 80, 96] to logits [1, 13, 320, 384]."""
        out: Tensor = self.net(features)
        return out


class CenterNetDecoder(nn.Module):
    """Maps the bird's eye view to boxes around the peaks of a heat map.

    The peaks are found by the host.
    """

    def __init__(self, config: LeadConfig) -> None:
        super().__init__()
        for name, channels in HEADS.items():
            head = nn.Sequential(
                nn.Conv2d(config.features, config.features, 3, padding=1),
                nn.ReLU(),
                nn.Conv2d(config.features, channels, 1),
            )
            self.add_module(name, head)

    def forward(self, features: Tensor) -> tuple[Tensor, ...]:
        """Map [1, 64, 80, 96] to maps of that size, the heat as probability."""
        heat, *others = (self.get_submodule(name)(features) for name in HEADS)
        return heat.sigmoid(), *others
