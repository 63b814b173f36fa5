"""Which ground will be taken."""

from torch import Tensor, nn

from me2e_compress.zoo.highway.config import STEPS, HighwayConfig
from me2e_compress.zoo.highway.layers import Residual, conv_block


class Occ(nn.Module):
    """Occupancy 0.5 to 3 s from now; never of now, which boxes already say."""

    def __init__(self, config: HighwayConfig) -> None:
        super().__init__()
        channels = config.channels
        self.body = nn.Sequential(
            Residual(channels, channels),
            conv_block(channels, channels // 2, 1),
            nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False),
            conv_block(channels // 2, channels // 2),
            nn.Conv2d(channels // 2, STEPS, 1),
        )

    def forward(self, bev: Tensor) -> Tensor:
        """[B, C, rows, columns] to logits [B, 6, 2 * rows, 2 * columns]."""
        taken: Tensor = self.body(bev).float()
        return taken
