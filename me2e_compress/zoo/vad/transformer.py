"""The perception transformer: BEV encoder, detection decoder, map decoder."""

import torch
from torch import Tensor, nn

from me2e_compress.zoo.bev.can_bus import CanBusEncoder
from me2e_compress.zoo.bev.decoder import Decoder
from me2e_compress.zoo.bev.encoder import BevEncoder
from me2e_compress.zoo.bev.reference_points import cell_positions, ego_shift, turn
from me2e_compress.zoo.bev.sizes import CAMERAS, EMBED, FEATURE_LEVELS, Sampling
from me2e_compress.zoo.regions import region
from me2e_compress.zoo.vad.config import LAYERS, VadConfig


class PerceptionTransformer(nn.Module):
    """Everything between camera features and decoded queries."""

    cells: Tensor

    def __init__(self, sampling: Sampling, config: VadConfig) -> None:
        super().__init__()
        self.sampling: Sampling = sampling
        self.grid = config.grid
        self.level_embeds = nn.Parameter(torch.empty(FEATURE_LEVELS, EMBED))
        self.cams_embeds = nn.Parameter(torch.empty(CAMERAS, EMBED))
        self.can_bus_mlp = CanBusEncoder()
        self.encoder = BevEncoder(
            config.grid, config.image_hw, config.feature_hws, LAYERS, sampling
        )
        self.reference_points = nn.Linear(EMBED, 3)
        self.decoder = Decoder(config.grid.hw, LAYERS, sampling, height=True)
        self.map_reference_points = nn.Linear(EMBED, 2)
        self.map_decoder = Decoder(config.grid.hw, LAYERS, sampling, height=False)
        self.register_buffer("cells", cell_positions(config.grid), False)

    def bev(
        self,
        features: Tensor,
        query: Tensor,
        pos: Tensor,
        lidar2img: Tensor,
        can_bus: Tensor,
        prev_bev: Tensor,
    ) -> Tensor:
        """Encode the cameras: [cameras, 256, h, w] to [1, cells, 256]."""
        tokens = features.flatten(2).transpose(1, 2)
        # Mark tokens by camera and level
        tokens = tokens + self.cams_embeds[:, None] + self.level_embeds[0]
        # The previous view, turned to the current heading
        first = torch.logical_not(torch.any(prev_bev != 0))
        previous = turn(prev_bev, can_bus, self.cells, self.grid, self.sampling)
        query = query + self.can_bus_mlp(can_bus.unsqueeze(0))
        shift = ego_shift(can_bus, self.grid)
        bev: Tensor = self.encoder(
            query, pos, previous, first, shift, tokens, lidar2img
        )
        return bev

    def forward(
        self,
        features: Tensor,
        cells: tuple[Tensor, Tensor],
        agents: Tensor,
        points: Tensor,
        branches: tuple[nn.ModuleList, nn.ModuleList],
        lidar2img: Tensor,
        can_bus: Tensor,
        prev_bev: Tensor,
    ) -> tuple[Tensor, tuple[list[Tensor], ...], tuple[list[Tensor], ...]]:
        """Encode features [cameras, 256, h, w] and decode agents and map points.

        ``cells`` are BEV queries and their positions, [1, cells, 256] each; ``agents``
        [300, 512] and ``points`` [2000, 512] are position then content; ``branches``
        are those of detection and map. Returns the BEV [1, cells, 256] and the results
        of both `Decoder`s.
        """
        with region("bev_encoder"):
            bev = self.bev(features, *cells, lidar2img, can_bus, prev_bev)
        with region("det"):
            pos, query = agents.unsqueeze(0).chunk(2, dim=2)
            at = self.reference_points(pos).sigmoid()
            found = self.decoder(query, pos, bev, at, branches[0])
        with region("map"):
            pos, query = points.unsqueeze(0).chunk(2, dim=2)
            at = self.map_reference_points(pos).sigmoid()
            mapped = self.map_decoder(query, pos, bev, at, branches[1])
        return bev, found, mapped
