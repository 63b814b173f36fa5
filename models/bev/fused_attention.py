"""Deformable attention that is exported as one node."""

import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.nn import functional

if TYPE_CHECKING:
    from torch.onnx._internal.torchscript_exporter.jit_utils import GraphContext

FUSED_NODE = "me2e::MultiScaleDeformableAttention"
"""The toolkit's own form, which ``translate-plugins`` turns into every dialect."""


def fused_deformable_attention(
    value: Tensor,
    hws: Sequence[tuple[int, int]],
    locations: Tensor,
    weights: Tensor,
) -> Tensor:
    """Compute `deformable_attention` as [B, Q, heads, 32], exported as one node."""
    apply: Callable[..., Tensor] = _Fused.apply
    flat = tuple(n for hw in hws for n in hw)  # the exporter takes no nested tuple
    return apply(value, flat, locations, weights)


class _Fused(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: object,
        value: Tensor,
        sizes: tuple[int, ...],
        locations: Tensor,
        weights: Tensor,
    ) -> Tensor:
        # Sample level by level
        hws = _pairs(sizes)
        batch, _, heads, channels = value.shape
        queries, points = locations.shape[1], locations.shape[4]
        maps = value.split([h * w for h, w in hws], 1)
        parts = []
        for level, hw in enumerate(hws):
            image = maps[level].permute(0, 2, 3, 1)
            image = image.reshape(batch * heads, channels, *hw)
            grid = (2 * locations[:, :, :, level] - 1).transpose(1, 2).flatten(0, 1)
            sampled = functional.grid_sample(image, grid, align_corners=False)
            share = weights[:, :, :, level].transpose(1, 2)
            share = share.reshape(batch * heads, 1, queries, points)
            parts.append((sampled * share).sum(-1))
        # Add up the levels
        summed = functools.reduce(torch.add, parts)
        return summed.view(batch, heads, channels, queries).permute(0, 3, 1, 2)

    @staticmethod
    def symbolic(
        g: "GraphContext",
        value: Any,  # of types of the exporter that say too little
        sizes: tuple[int, ...],
        locations: Any,
        weights: Any,
    ) -> Any:
        """Write the node with constant sizes, and the shape of its output."""
        shapes = torch.tensor(_pairs(sizes), dtype=torch.int32)
        cells = shapes.prod(1)
        starts = (cells.cumsum(0) - cells).to(torch.int32)
        tables: list[Any] = [
            g.op("Constant", value_t=each) for each in (shapes, starts)
        ]
        result: Any = g.op(FUSED_NODE, value, *tables, locations, weights)
        batch, _, heads, channels = value.type().sizes()
        queries = locations.type().sizes()[1]
        result.setType(value.type().with_sizes([batch, queries, heads, channels]))
        return result


def _pairs(flat: Sequence[int]) -> list[tuple[int, int]]:
    return list(zip(flat[::2], flat[1::2], strict=True))
