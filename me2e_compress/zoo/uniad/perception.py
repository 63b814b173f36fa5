"""The perception head of UniAD: the bird's eye view, and the queries that read it."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from me2e_compress.zoo.bev.can_bus import CanBusEncoder
from me2e_compress.zoo.bev.decoder import (
    Decoder,
    in_metres,
    inverse_sigmoid,
    precise_sigmoid,
)
from me2e_compress.zoo.bev.encoder import BevEncoder, GridPosition
from me2e_compress.zoo.bev.reference_points import cell_positions, ego_shift, turn
from me2e_compress.zoo.bev.sizes import (
    BOX_CODE,
    CAMERAS,
    EMBED,
    FEATURE_LEVELS,
    Sampling,
)
from me2e_compress.zoo.regions import region
from me2e_compress.zoo.uniad.config import UniadConfig
from me2e_compress.zoo.uniad.layers import mlp, projection

PAST_STEPS = 8


class Motions(NamedTuple):
    """The vehicle's motion and the previous view."""

    lidar2img: Tensor  # [1, cameras, 4, 4]
    can_bus: Tensor  # [18]
    prev_bev: Tensor  # [cells, 1, 256]


class Queries(NamedTuple):
    """Track queries before they read the view."""

    query: Tensor  # [1, Q, 512], position then content
    reference: Tensor  # [1, Q, 3], logits
    ignore: Tensor  # [1, Q] bool: empty slots


class Found(NamedTuple):
    """The result of the track decoder."""

    bev: Tensor  # [1, cells, 256]
    bev_pos: Tensor  # [1, cells, 256]
    scores: Tensor  # [layers, 1, Q, classes], logits
    boxes: Tensor  # [layers, 1, Q, 10], metres
    embeddings: Tensor  # [Q, 256], of the last layer
    reference: Tensor  # [Q, 3], of the last layer, logits


class TrackTransformer(nn.Module):
    """BEV encoder and track decoder."""

    def __init__(self, config: UniadConfig, sampling: Sampling) -> None:
        super().__init__()
        self.grid = config.grid
        self.sampling: Sampling = sampling
        self.level_embeds = nn.Parameter(torch.empty(FEATURE_LEVELS, EMBED))
        self.cams_embeds = nn.Parameter(torch.empty(CAMERAS, EMBED))
        self.can_bus_mlp = CanBusEncoder()
        self.encoder = BevEncoder(
            config.grid, config.image_hw, config.hws, config.encoder_layers, sampling
        )
        self.decoder = Decoder(
            config.grid.hw, config.decoder_layers, sampling, height=True, precise=True
        )
        self.register_buffer("cells", cell_positions(config.grid), False)

    cells: Tensor

    def bev(
        self, levels: list[Tensor], query: Tensor, pos: Tensor, motions: Motions
    ) -> Tensor:
        """Encode levels [cameras, 256, h, w] to [1, cells, 256]."""
        # Tokens of all cameras and levels
        tokens = torch.cat(
            [
                level.flatten(2).transpose(1, 2)
                + self.cams_embeds[:, None]
                + self.level_embeds[index]
                for index, level in enumerate(levels)
            ],
            1,
        )
        # The previous view, turned to the current heading
        lidar2img, can_bus, prev_bev = motions
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
        levels: list[Tensor],
        cells: tuple[Tensor, Tensor],
        motions: Motions,
        queries: Queries,
        branches: nn.ModuleList,
    ) -> tuple[Tensor, tuple[list[Tensor], ...]]:
        """Encode levels [cameras, 256, h, w], then decode the track queries.

        ``cells`` are BEV queries and their positions, [1, cells, 256] each.
        """
        with region("bev_encoder"):
            bev = self.bev(levels, *cells, motions)
        with region("track"):
            pos, content = queries.query.chunk(2, 2)
            reference = precise_sigmoid(queries.reference)
            found = self.decoder(content, pos, bev, reference, branches, queries.ignore)
        return bev, found


class TrackHead(nn.Module):
    """The perception transformer, and the branches that read it."""

    def __init__(self, config: UniadConfig, sampling: Sampling, *, dead: bool) -> None:
        super().__init__()
        self.grid = config.grid
        layers = range(config.decoder_layers)
        self.code_weights = nn.Parameter(torch.empty(BOX_CODE))
        self.positional_encoding = GridPosition(config.grid.hw)
        self.transformer = TrackTransformer(config, sampling)
        self.bev_embedding = nn.Embedding(config.grid.cells, EMBED)
        # One branch per decoder layer
        self.cls_branches = nn.ModuleList(
            nn.Sequential(
                *projection(EMBED, EMBED),
                *projection(EMBED, EMBED),
                nn.Linear(EMBED, config.labels.classes),
            )
            for _ in layers
        )
        self.reg_branches = nn.ModuleList(
            mlp(EMBED, EMBED, EMBED, BOX_CODE) for _ in layers
        )
        if dead:
            self.past_traj_reg_branches = nn.ModuleList(
                mlp(EMBED, EMBED, EMBED, PAST_STEPS * 2) for _ in layers
            )

    def forward(
        self, levels: list[Tensor], motions: Motions, queries: Queries
    ) -> Found:
        """Encode the view and decode the queries."""
        # Encode the view and decode the queries
        with region("bev_encoder"):
            pos = self.positional_encoding()
            cells = self.bev_embedding.weight.unsqueeze(0), pos
        bev, decoded = self.transformer(
            levels, cells, motions, queries, self.reg_branches
        )
        # Apply the branches
        with region("track"):
            states, raw, at = decoded
            scores = [
                branch(state)
                for branch, state in zip(self.cls_branches, states, strict=True)
            ]
            boxes = [
                in_metres(each, place, self.grid)
                for each, place in zip(raw, at, strict=True)
            ]
            return Found(
                bev,
                pos,
                torch.stack(scores),
                torch.stack(boxes),
                states[-1][0],
                inverse_sigmoid(at[-1][0]),
            )
