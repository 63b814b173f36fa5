"""Decoders that refine reference points layer by layer (deformable DETR)."""

import torch
from torch import Tensor, nn

from models.bev.attention import DecoderAttention, MultiheadAttention
from models.bev.layers import AttentionLayer
from models.bev.sizes import BevGrid, Sampling

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


Decoded = tuple[list[Tensor], list[Tensor], list[Tensor]]
"""What a `Decoder` returns for its layers: queries, raw regressions, references."""


class Decoder(nn.Module):
    """Self-attention and attention to the BEV in layers, and a branch for each.

    ``precise`` is for references that are fed back.
    """

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
        self.layers = nn.ModuleList(
            AttentionLayer(MultiheadAttention(), DecoderAttention(hw, sampling))
            for _ in range(layers)
        )

    def forward(
        self,
        query: Tensor,
        pos: Tensor,
        bev: Tensor,
        reference: Tensor,
        branches: nn.ModuleList,
        ignore: Tensor | None = None,
    ) -> Decoded:
        """Decode queries [1, Q, 256] with references [1, Q, 2 or 3], 0..1.

        Columns 0 and 1 of a layer's branch, and 4 with heights, move the reference.
        ``ignore`` is [1, Q] bool, true for queries that the others must not see.
        Returns for every layer queries [1, Q, 256], raw regressions [1, Q, code] and
        refined references.
        """
        queries, regressions, references = [], [], []
        for layer, branch in zip(self.layers, branches, strict=True):
            known = query, pos, pos, ignore
            query = layer(query, known, (pos, bev, reference[..., :2]))
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


def detections(
    decoded: Decoded, branches: nn.ModuleList, grid: BevGrid
) -> tuple[Tensor, Tensor]:
    """Return the scores of all layers, [layers, 1, Q, classes], and boxes in metres."""
    queries, regressions, references = decoded
    scores = [branch(query) for branch, query in zip(branches, queries, strict=True)]
    boxes = [
        in_metres(raw, at, grid)
        for raw, at in zip(regressions, references, strict=True)
    ]
    return torch.stack(scores), torch.stack(boxes)


class Interaction(nn.Module):
    """Cross-attention of one kind of query to another, and a feed-forward."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.ModuleList([AttentionLayer(MultiheadAttention())])

    def forward(
        self,
        query: Tensor,
        key: Tensor,
        query_pos: Tensor,
        key_pos: Tensor,
        ignore: Tensor | None = None,
    ) -> Tensor:
        """Map [B, Q, 256] and keys [B or 1, K, 256] to [B, Q, 256]."""
        out: Tensor = self.layers[0](query, (key, query_pos, key_pos, ignore))
        return out
