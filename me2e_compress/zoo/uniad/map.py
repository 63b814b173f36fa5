"""The map head of UniAD: lanes as queries, boxes and masks."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from me2e_compress.zoo.bev.attention import (
    DecoderAttention,
    FeedForward,
    MultiheadAttention,
)
from me2e_compress.zoo.bev.decoder import inverse_sigmoid
from me2e_compress.zoo.bev.sizes import EMBED, Sampling
from me2e_compress.zoo.uniad.config import UniadConfig
from me2e_compress.zoo.uniad.layers import mlp
from me2e_compress.zoo.uniad.map_masks import MaskHead
from me2e_compress.zoo.uniad.positions import CellSines

THING_BLOCKS, STUFF_BLOCKS = 4, 6
LEVEL_EMBEDDINGS = 4
"""Level embeddings, of which only the first is read."""


class CellLayer(nn.Module):
    """Cells attend to cells around them, then feed-forward."""

    def __init__(self, hw: tuple[int, int], sampling: Sampling, levels: int) -> None:
        super().__init__()
        self.attentions = nn.ModuleList([DecoderAttention(hw, sampling, held=levels)])
        self.ffns = nn.ModuleList([FeedForward()])
        self.norms = nn.ModuleList(nn.LayerNorm(EMBED) for _ in range(2))

    def forward(self, cells: Tensor, pos: Tensor, at: Tensor) -> Tensor:
        """Map [1, cells, 256] to [1, cells, 256]; ``at`` are their positions, 0..1."""
        cells = self.norms[0](self.attentions[0](cells, pos, cells, at))
        out: Tensor = self.norms[1](self.ffns[0](cells))
        return out


class CellEncoder(nn.Module):
    """Six `CellLayer`s."""

    def __init__(self, config: UniadConfig, sampling: Sampling, levels: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            CellLayer(config.head_hw, sampling, levels)
            for _ in range(config.decoder_layers)
        )

    def forward(self, cells: Tensor, pos: Tensor, at: Tensor) -> Tensor:
        """Map [1, cells, 256] to the same; ``at`` are their positions, 0..1."""
        for layer in self.layers:
            cells = layer(cells, pos, at)
        return cells


class LaneLayer(nn.Module):
    """Self-attention, cross-attention to the cells, feed-forward."""

    def __init__(
        self, hw: tuple[int, int], sampling: Sampling, levels: int, *, boxes: bool
    ) -> None:
        super().__init__()
        read = DecoderAttention(hw, sampling, held=levels, boxes=boxes)
        self.attentions = nn.ModuleList([MultiheadAttention(), read])
        self.ffns = nn.ModuleList([FeedForward()])
        self.norms = nn.ModuleList(nn.LayerNorm(EMBED) for _ in range(3))

    def forward(self, query: Tensor, pos: Tensor, cells: Tensor, at: Tensor) -> Tensor:
        """Map [1, Q, 256] to [1, Q, 256]; ``at`` are points or boxes, 0..1."""
        query = self.norms[0](self.attentions[0](query, query, pos, pos))
        query = self.norms[1](self.attentions[1](query, pos, cells, at))
        out: Tensor = self.norms[2](self.ffns[0](query))
        return out


class LaneDecoder(nn.Module):
    """Six `LaneLayer`s."""

    def __init__(self, config: UniadConfig, sampling: Sampling, levels: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            LaneLayer(config.head_hw, sampling, levels, boxes=layer > 0)
            for layer in range(config.decoder_layers)
        )

    def forward(
        self,
        lanes: tuple[Tensor, Tensor],
        cells: Tensor,
        at: Tensor,
        branches: nn.ModuleList,
    ) -> tuple[Tensor, Tensor]:
        """Refine lanes, content and position [1, lanes, 256]; also return boxes."""
        query, pos = lanes
        layers = zip(self.layers, branches, strict=True)
        for number, (layer, branch) in enumerate(layers):
            query = layer(query, pos, cells, at)
            moved = branch(query)
            centre = moved[..., :2] + inverse_sigmoid(at[..., :2])
            size = moved[..., 2:]
            if number > 0:  # until then there are points, not boxes
                size = size + inverse_sigmoid(at[..., 2:])
            at = torch.cat([centre, size], -1).sigmoid()
        return query, at


class MapTransformer(nn.Module):
    """A cell encoder, and lane queries that read its result (deformable DETR)."""

    def __init__(self, config: UniadConfig, sampling: Sampling, levels: int) -> None:
        super().__init__()
        self.encoder = CellEncoder(config, sampling, levels)
        self.decoder = LaneDecoder(config, sampling, levels)
        self.level_embeds = nn.Parameter(torch.empty(LEVEL_EMBEDDINGS, EMBED))
        self.reference_points = nn.Linear(EMBED, 2)
        rows, columns = torch.meshgrid(
            (torch.arange(config.head_hw[0]) + 0.5) / config.head_hw[0],
            (torch.arange(config.head_hw[1]) + 0.5) / config.head_hw[1],
            indexing="ij",
        )
        places = torch.stack([columns, rows], -1).view(1, -1, 2)
        self.register_buffer("places", places, False)

    places: Tensor

    def forward(
        self, cells: Tensor, pos: Tensor, lanes: Tensor, branches: nn.ModuleList
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Decode lanes [lanes, 512], position then content, from cells [1, cells, 256].

        Returns cells, lane queries [1, lanes, 256] and boxes [1, lanes, 4] (cx, cy, w,
        h).
        """
        pos = pos + self.level_embeds[0]
        cells = self.encoder(cells, pos, self.places)
        lane_pos, query = lanes.unsqueeze(0).chunk(2, 2)
        at = self.reference_points(lane_pos).sigmoid()
        query, at = self.decoder((query, lane_pos), cells, at, branches)
        return cells, query, at


class Lanes(NamedTuple):
    """The result of the map head."""

    query: Tensor  # [1, lanes, 256]
    pos: Tensor  # [1, lanes, 256]
    scores: Tensor  # [1, lanes, things], logits
    boxes: Tensor  # [1, lanes, 4], cx cy w h, 0..1
    masks: Tensor  # [1, lanes, rows, columns]


class MapHead(nn.Module):
    """Finds lanes in the upsampled view.

    ``dead`` holds weights that inference never reads: an embedding of the cells, the
    background head, the branches of the mask heads, attention for three more levels.
    ``trained`` uses that attention as in training (see `DecoderAttention`).
    """

    def __init__(
        self,
        config: UniadConfig,
        sampling: Sampling,
        *,
        dead: bool = False,
        trained: bool = False,
    ) -> None:
        super().__init__()
        # Unused levels are held only for published weights
        levels = config.map_levels if dead or trained else 1
        layers, things = config.decoder_layers, config.labels.things
        self.hw = config.head_hw
        self.positional_encoding = CellSines(self.hw)
        self.query_embedding = nn.Embedding(config.map_queries, 2 * EMBED)
        self.transformer = MapTransformer(config, sampling, levels)
        self.cls_branches = nn.ModuleList(
            nn.Linear(EMBED, things) for _ in range(layers)
        )
        self.reg_branches = nn.ModuleList(_boxes() for _ in range(layers))
        self.things_mask_head = MaskHead(THING_BLOCKS)
        # Weights that inference never reads
        if dead:
            cells = config.head_hw[0] * config.head_hw[1]
            self.bev_embedding = nn.Embedding(cells, EMBED)
            self.stuff_mask_head = MaskHead(STUFF_BLOCKS, self_attention=True)
            self.reg_branches2 = nn.ModuleList(_boxes() for _ in range(THING_BLOCKS))
            self.cls_thing_branches = nn.ModuleList(
                nn.Linear(EMBED, things) for _ in range(THING_BLOCKS)
            )
            self.cls_stuff_branches = nn.ModuleList(
                nn.Linear(EMBED, 1) for _ in range(STUFF_BLOCKS)
            )

    def forward(self, bev: Tensor) -> Lanes:
        """Find lanes in the upsampled view, [1, cells, 256]."""
        lanes, pos = self.query_embedding.weight, self.positional_encoding()
        cells, query, boxes = self.transformer(bev, pos, lanes, self.reg_branches)
        lane_pos = lanes[None, :, :EMBED]
        masks = self.things_mask_head(query, lane_pos, cells, pos)
        masks = masks.unflatten(2, self.hw)
        return Lanes(query, lane_pos, self.cls_branches[-1](query), boxes, masks)


def _boxes() -> nn.Sequential:
    return mlp(EMBED, EMBED, EMBED, 4)
