"""The perception head of UniAD: the bird's eye view, and the queries that read it."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from models.bev.decoder import (
    Decoded,
    Decoder,
    detections,
    inverse_sigmoid,
    precise_sigmoid,
)
from models.bev.encoder import GridPosition
from models.bev.layers import classifier, mlp
from models.bev.sizes import BOX_CODE, EMBED, Sampling
from models.bev.transformer import BevTransformer, Motions
from models.regions import region
from models.uniad.config import UniadConfig


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


class TrackTransformer(BevTransformer):
    """BEV encoder and track decoder."""

    def __init__(self, config: UniadConfig, sampling: Sampling) -> None:
        super().__init__(
            config.grid, config.image_hw, config.hws, config.encoder_layers, sampling
        )
        self.decoder = Decoder(
            config.grid.hw, config.decoder_layers, sampling, height=True, precise=True
        )

    def forward(
        self,
        levels: list[Tensor],
        cells: tuple[Tensor, Tensor],
        motions: Motions,
        queries: Queries,
        branches: nn.ModuleList,
    ) -> tuple[Tensor, Decoded]:
        """Encode levels [cameras, 256, h, w], then decode the track queries.

        ``cells`` are BEV queries and their positions, [1, cells, 256] each.
        """
        with region("bev_encoder"):
            tokens = torch.cat(self.tokens(levels), 1)
            bev = self.bev(tokens, cells, motions)
        with region("track"):
            pos, content = queries.query.chunk(2, 2)
            reference = precise_sigmoid(queries.reference)
            found = self.decoder(content, pos, bev, reference, branches, queries.ignore)
        return bev, found


class TrackHead(nn.Module):
    """The perception transformer, and the branches that read it."""

    def __init__(self, config: UniadConfig, sampling: Sampling) -> None:
        super().__init__()
        self.grid = config.grid
        layers = range(config.decoder_layers)
        self.code_weights = nn.Parameter(torch.empty(BOX_CODE))
        self.positional_encoding = GridPosition(config.grid.hw)
        self.transformer = TrackTransformer(config, sampling)
        self.bev_embedding = nn.Embedding(config.grid.cells, EMBED)
        # One branch per decoder layer
        self.cls_branches = nn.ModuleList(
            classifier(config.labels.classes) for _ in layers
        )
        self.reg_branches = nn.ModuleList(
            mlp(EMBED, EMBED, EMBED, BOX_CODE) for _ in layers
        )

    def forward(
        self, levels: list[Tensor], motions: Motions, queries: Queries
    ) -> Found:
        """Encode the view and decode the queries."""
        with region("bev_encoder"):
            pos = self.positional_encoding()
            cells = self.bev_embedding.weight.unsqueeze(0), pos
        bev, decoded = self.transformer(
            levels, cells, motions, queries, self.reg_branches
        )
        # Apply the branches
        with region("track"):
            scores, boxes = detections(decoded, self.cls_branches, self.grid)
            states, _, at = decoded
            state, reference = states[-1][0], inverse_sigmoid(at[-1][0])
            return Found(bev, pos, scores, boxes, state, reference)
