"""Decoders that refine reference points layer by layer (deformable DETR)."""

import torch
from torch import Tensor, nn

from me2e_compress.zoo.bev.attention import (
    DecoderAttention,
    FeedForward,
    MultiheadAttention,
)
from me2e_compress.zoo.bev.sizes import EMBED, BevGrid, Sampling

EPSILON = torch.tensor(1.0e-5)
"""Keeps the inverse sigmoid finite (deformable DETR). A tensor: the exporter would
write a Python number as float64."""


def inverse_sigmoid(x: Tensor) -> Tensor:
    """Return the logit of x in 0..1, kept away from 0 and 1 by `EPSILON`."""
    return torch.log(torch.maximum(x, EPSILON) / torch.maximum(1 - x, EPSILON))


def precise_sigmoid(x: Tensor) -> Tensor:
    """Return 1 / (1 + exp(-x)) with full relative precision for small results.

    onnxruntime's Sigmoid is exact to 8e-8: near 1e-5, where `inverse_sigmoid` ends,
    that moves the logit by 8e-3.
    """
    return torch.reciprocal(1 + torch.exp(-x))


def in_metres(raw: Tensor, at: Tensor, grid: BevGrid) -> Tensor:
    """Convert raw boxes [..., 10] with refined centres (0..1) to metres."""
    x0, y0, z0, x1, y1, z1 = grid.pc_range
    x = at[..., 0:1] * (x1 - x0) + x0
    y = at[..., 1:2] * (y1 - y0) + y0
    z = at[..., 2:3] * (z1 - z0) + z0
    return torch.cat([x, y, raw[..., 2:4], z, raw[..., 5:]], -1)


class DecoderLayer(nn.Module):
    """Self-attention, cross-attention to the BEV, and feed-forward."""

    def __init__(self, hw: tuple[int, int], sampling: Sampling) -> None:
        super().__init__()
        self.attentions = nn.ModuleList(
            [MultiheadAttention(), DecoderAttention(hw, sampling)]
        )
        self.ffns = nn.ModuleList([FeedForward()])
        self.norms = nn.ModuleList(nn.LayerNorm(EMBED) for _ in range(3))

    def forward(
        self,
        query: Tensor,
        pos: Tensor,
        bev: Tensor,
        at: Tensor,
        ignore: Tensor | None = None,
    ) -> Tensor:
        """Map [1, Q, 256] to the same; ``at`` is [1, Q, 2], ``ignore`` [1, Q] bool."""
        query = self.norms[0](self.attentions[0](query, query, pos, pos, ignore))
        query = self.norms[1](self.attentions[1](query, pos, bev, at))
        out: Tensor = self.norms[2](self.ffns[0](query))
        return out


class Decoder(nn.Module):
    """`DecoderLayer`s and branches; ``precise`` if references are fed back."""

    def __init__(
        self,
        hw: tuple[int, int],
        layers: int,
        sampling: Sampling,
        *,
        height: bool,
        precise: bool = False,
    ) -> None:
        super().__init__()
        self.height = height
        self.sigmoid = precise_sigmoid if precise else torch.sigmoid
        self.layers = nn.ModuleList(DecoderLayer(hw, sampling) for _ in range(layers))

    def forward(
        self,
        query: Tensor,
        pos: Tensor,
        bev: Tensor,
        reference: Tensor,
        branches: nn.ModuleList,
        ignore: Tensor | None = None,
    ) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
        """Decode queries [1, Q, 256] with references [1, Q, 2 or 3], 0..1.

        Columns 0 and 1 of a layer's branch, and 4 with heights, move the reference.
        ``ignore`` is [1, Q] bool, true for queries that the others must not see.
        Returns for every layer queries [1, Q, 256], raw regressions [1, Q, code] and
        refined references.
        """
        queries, regressions, references = [], [], []
        for layer, branch in zip(self.layers, branches, strict=True):
            query = layer(query, pos, bev, reference[..., :2], ignore)
            raw = branch(query)
            # Move the reference in logit space
            moves = raw[..., :2]
            if self.height:
                moves = torch.cat([moves, raw[..., 4:5]], -1)
            reference = self.sigmoid(moves + inverse_sigmoid(reference))
            queries.append(query)
            regressions.append(raw)
            references.append(reference)
        return queries, regressions, references


class InteractionLayer(nn.Module):
    """Cross-attention and feed-forward."""

    def __init__(self) -> None:
        super().__init__()
        self.attentions = nn.ModuleList([MultiheadAttention()])
        self.ffns = nn.ModuleList([FeedForward()])
        self.norms = nn.ModuleList(nn.LayerNorm(EMBED) for _ in range(2))

    def forward(
        self,
        query: Tensor,
        key: Tensor,
        query_pos: Tensor,
        key_pos: Tensor,
        ignore: Tensor | None,
    ) -> Tensor:
        """Map [B, Q, 256] and keys [B or 1, K, 256] to [B, Q, 256]."""
        attended = self.attentions[0](query, key, query_pos, key_pos, ignore)
        query = self.norms[0](attended)
        out: Tensor = self.norms[1](self.ffns[0](query))
        return out


class Interaction(nn.Module):
    """Cross-attention of one kind of query to another: one `InteractionLayer`."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.ModuleList([InteractionLayer()])

    def forward(
        self,
        query: Tensor,
        key: Tensor,
        query_pos: Tensor,
        key_pos: Tensor,
        ignore: Tensor | None = None,
    ) -> Tensor:
        """Apply the layer."""
        out: Tensor = self.layers[0](query, key, query_pos, key_pos, ignore)
        return out
