"""What VAD-tiny and UniAD-tiny do between camera features and a bird's eye view."""

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from models.bev.attention import Levels
from models.bev.encoder import BevEncoder
from models.bev.reference_points import cell_positions, ego_shift, turn
from models.bev.sizes import (
    CAMERAS,
    EMBED,
    FEATURE_LEVELS,
    BevGrid,
    Sampling,
)

CAN_BUS = 18
"""Metres since the last frame (3), quaternion (4), speed (3), acceleration (3), angular
rate (3), yaw in radians, change of yaw in degrees."""


class Motions(NamedTuple):
    """The vehicle's motion and the previous view."""

    lidar2img: Tensor  # [1, cameras, 4, 4]
    can_bus: Tensor  # [18]
    prev_bev: Tensor  # [cells, 1, 256]


class CanBusEncoder(nn.Sequential):
    """Maps ego motion to a vector that is added to every BEV query."""

    def __init__(self) -> None:
        super().__init__(
            nn.Linear(CAN_BUS, EMBED // 2),
            nn.ReLU(),
            nn.Linear(EMBED // 2, EMBED),
            nn.ReLU(),
        )
        self.add_module("norm", nn.LayerNorm(EMBED))


class BevTransformer(nn.Module):
    """The BEV encoder and its embeddings; heads add their decoders."""

    cells: Tensor

    def __init__(
        self,
        grid: BevGrid,
        image_hw: tuple[int, int],
        hws: Levels,
        layers: int,
        sampling: Sampling,
    ) -> None:
        super().__init__()
        self.grid = grid
        self.sampling: Sampling = sampling
        self.level_embeds = nn.Parameter(torch.empty(FEATURE_LEVELS, EMBED))
        self.cams_embeds = nn.Parameter(torch.empty(CAMERAS, EMBED))
        self.can_bus_mlp = CanBusEncoder()
        self.encoder = BevEncoder(grid, image_hw, hws, layers, sampling)
        self.register_buffer("cells", cell_positions(grid), False)

    def tokens(self, levels: Iterable[Tensor]) -> list[Tensor]:
        """Mark levels [cameras, 256, h, w] by camera and level: [cameras, h * w, 256].

        They are not joined yet.
        """
        return [
            level.flatten(2).transpose(1, 2)
            + self.cams_embeds[:, None]
            + self.level_embeds[index]
            for index, level in enumerate(levels)
        ]

    def bev(
        self, tokens: Tensor, cells: tuple[Tensor, Tensor], motions: Motions
    ) -> Tensor:
        """Encode the tokens of all cameras and levels to [1, cells, 256].

        ``cells`` are BEV queries and their positions, [1, cells, 256] each.
        """
        query, pos = cells
        lidar2img, can_bus, prev_bev = motions
        # The previous view, turned to the current heading
        first = torch.logical_not(torch.any(prev_bev != 0))
        previous = turn(prev_bev, can_bus, self.cells, self.grid, self.sampling)
        query = query + self.can_bus_mlp(can_bus.unsqueeze(0))
        shift = ego_shift(can_bus, self.grid)
        bev: Tensor = self.encoder(
            query, pos, previous, first, shift, tokens, lidar2img
        )
        return bev
