"""The map head of UniAD: lanes as queries, boxes and masks (Panoptic SegFormer)."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from models.bev.attention import (
    HEAD_SCALE,
    DecoderAttention,
    MultiheadAttention,
)
from models.bev.decoder import inverse_sigmoid
from models.bev.layers import AttentionLayer, mlp
from models.bev.reference_points import cell_centres
from models.bev.sizes import ATTENTION_HEADS, EMBED, Sampling
from models.uniad.config import UniadConfig
from models.uniad.positions import CellSines

MASK_BLOCKS = 4
MASK_FEED_FORWARD = 1024
LEVEL_EMBEDDINGS = 4
"""Level embeddings, of which only the first is read."""


class CellEncoder(nn.Module):
    """Layers in which cells attend to cells around them."""

    def __init__(self, config: UniadConfig, sampling: Sampling, levels: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            AttentionLayer(DecoderAttention(config.head_hw, sampling, held=levels))
            for _ in range(config.decoder_layers)
        )

    def forward(self, cells: Tensor, pos: Tensor, at: Tensor) -> Tensor:
        """Map [1, cells, 256] to the same; ``at`` are their positions, 0..1."""
        for layer in self.layers:
            cells = layer(cells, (pos, cells, at))
        return cells


class LaneDecoder(nn.Module):
    """Layers of self-attention and attention to the cells."""

    def __init__(self, config: UniadConfig, sampling: Sampling, levels: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            AttentionLayer(
                MultiheadAttention(),
                DecoderAttention(
                    config.head_hw, sampling, held=levels, boxes=layer > 0
                ),
            )
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
            query = layer(query, (query, pos, pos), (pos, cells, at))
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
        self.register_buffer("places", cell_centres(config.head_hw), False)

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


class MaskAttention(nn.Module):
    """Attention of queries to cells, from which a mask is computed."""

    def __init__(self, *, tail: bool = False) -> None:
        super().__init__()
        self.q = nn.Linear(EMBED, EMBED)
        self.k = nn.Linear(EMBED, EMBED)
        self.tail = tail
        if not tail:
            self.v = nn.Linear(EMBED, EMBED)
            self.proj = nn.Linear(EMBED, EMBED)
        heads = ATTENTION_HEADS
        self.linear_l1 = nn.Sequential(nn.Linear(heads, heads), nn.ReLU())
        self.linear = nn.Sequential(nn.Linear(heads, 1), nn.ReLU())

    def forward(
        self, query: Tensor, key: Tensor, value: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Map [1, Q, 256] and cells [1, K, 256] to [1, Q, 256] and masks [1, Q, K].

        The last layer, the tail, returns its query unchanged.
        """
        q, k = _heads(self.q(query)), _heads(self.k(key))
        logits = torch.matmul(q, k.transpose(-2, -1)) * HEAD_SCALE
        mask = self.linear(self.linear_l1(logits.permute(0, 2, 3, 1))).squeeze(-1)
        if self.tail:
            return query, mask
        mixed = torch.matmul(logits.softmax(-1), _heads(self.v(value)))
        return self.proj(mixed.transpose(1, 2).flatten(2)), mask


def _heads(x: Tensor) -> Tensor:
    heads: Tensor = x.unflatten(2, (ATTENTION_HEADS, -1)).transpose(1, 2)
    return heads


class GeluFeedForward(nn.Module):
    """Linear, GELU, linear."""

    def __init__(self) -> None:
        super().__init__()
        self.fc1 = nn.Linear(EMBED, MASK_FEED_FORWARD)
        self.act = nn.GELU()
        self.fc2 = nn.Linear(MASK_FEED_FORWARD, EMBED)

    def forward(self, x: Tensor) -> Tensor:
        """Map [..., 256] to [..., 256]."""
        out: Tensor = self.fc2(self.act(self.fc1(x)))
        return out


class MaskBlock(nn.Module):
    """`MaskAttention` and `GeluFeedForward`, each normalised."""

    def __init__(self) -> None:
        super().__init__()
        self.head_norm1 = nn.LayerNorm(EMBED, eps=1e-6)
        self.attn = MaskAttention()
        self.head_norm2 = nn.LayerNorm(EMBED, eps=1e-6)
        self.mlp = GeluFeedForward()

    def forward(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Map [1, Q, 256] and cells [1, K, 256] to [1, Q, 256]."""
        attended, _ = self.attn(query, key, value)
        query = self.head_norm1(query + attended)
        out: Tensor = self.head_norm2(query + self.mlp(query))
        return out


class MaskHead(nn.Module):
    """Maps queries to masks over the cells."""

    def __init__(self, blocks: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(MaskBlock() for _ in range(blocks))
        self.attnen = MaskAttention(tail=True)

    def forward(
        self, query: Tensor, query_pos: Tensor, cells: Tensor, cells_pos: Tensor
    ) -> Tensor:
        """Map [1, Q, 256] and cells [1, K, 256] to masks [1, Q, K]."""
        key = cells + cells_pos
        for block in self.blocks:
            query = block(query + query_pos, key, cells)
        mask: Tensor = self.attnen(query + query_pos, key, cells)[1]
        return mask


class Lanes(NamedTuple):
    """The result of the map head."""

    query: Tensor  # [1, lanes, 256]
    pos: Tensor  # [1, lanes, 256]
    scores: Tensor  # [1, lanes, things], logits
    boxes: Tensor  # [1, lanes, 4], cx cy w h, 0..1
    masks: Tensor  # [1, lanes, rows, columns]


class MapHead(nn.Module):
    """Finds lanes in the upsampled view.

    ``trained`` is for published weights, whose attention holds levels that are not
    there (see `DecoderAttention`).
    """

    def __init__(
        self, config: UniadConfig, sampling: Sampling, *, trained: bool
    ) -> None:
        super().__init__()
        levels = config.map_levels if trained else 1
        layers, things = config.decoder_layers, config.labels.things
        self.hw = config.head_hw
        self.positional_encoding = CellSines(self.hw)
        self.query_embedding = nn.Embedding(config.map_queries, 2 * EMBED)
        self.transformer = MapTransformer(config, sampling, levels)
        self.cls_branches = nn.ModuleList(
            nn.Linear(EMBED, things) for _ in range(layers)
        )
        self.reg_branches = nn.ModuleList(
            mlp(EMBED, EMBED, EMBED, 4) for _ in range(layers)
        )
        self.things_mask_head = MaskHead(MASK_BLOCKS)

    def forward(self, bev: Tensor) -> Lanes:
        """Find lanes in the upsampled view, [1, cells, 256]."""
        lanes, pos = self.query_embedding.weight, self.positional_encoding()
        cells, query, boxes = self.transformer(bev, pos, lanes, self.reg_branches)
        lane_pos = lanes[None, :, :EMBED]
        masks = self.things_mask_head(query, lane_pos, cells, pos)
        masks = masks.unflatten(2, self.hw)
        return Lanes(query, lane_pos, self.cls_branches[-1](query), boxes, masks)
