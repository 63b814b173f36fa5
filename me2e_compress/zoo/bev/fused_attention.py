"""Deformable attention that is exported as one node."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.nn import functional

if TYPE_CHECKING:
    from torch.onnx._internal.torchscript_exporter.jit_utils import GraphContext

FUSED_NODE = "me2e::MultiScaleDeformableAttention"
"""The toolkit's own form, which ``translate-plugins`` turns into every dialect."""


def fused_deformable_attention(
    value: Tensor, hw: tuple[int, int], locations: Tensor, weights: Tensor
) -> Tensor:
    """Map as `deformable_attention` does, to [B, Q, heads, 32]; exports one node."""
    apply: Callable[..., Tensor] = _Fused.apply
    return apply(value, hw, locations, weights)


class _Fused(torch.autograd.Function):
    """Samples of one feature level, weighted and summed; no gradient."""

    @staticmethod
    def forward(
        ctx: object,
        value: Tensor,
        hw: tuple[int, int],
        locations: Tensor,
        weights: Tensor,
    ) -> Tensor:
        """Compute it by torch's own sampler."""
        batch, _, heads, channels = value.shape
        queries, points = locations.shape[1], locations.shape[4]
        image = value.permute(0, 2, 3, 1).reshape(batch * heads, channels, *hw)
        grid = (2 * locations - 1)[:, :, :, 0].transpose(1, 2).flatten(0, 1)
        sampled = functional.grid_sample(image, grid, align_corners=False)
        weights = weights.transpose(1, 2).reshape(batch * heads, 1, queries, points)
        summed = (sampled * weights).sum(-1).view(batch, heads, channels, queries)
        return summed.permute(0, 3, 1, 2)

    @staticmethod
    def symbolic(
        g: "GraphContext",
        value: Any,  # of types of the exporter that say too little
        hw: tuple[int, int],
        locations: Any,
        weights: Any,
    ) -> Any:
        """Write the node, its sizes constants, with the shape of what it gives."""
        sizes = torch.tensor([hw], dtype=torch.int32)
        starts = torch.zeros(1, dtype=torch.int32)
        tables: list[Any] = [g.op("Constant", value_t=each) for each in (sizes, starts)]
        result: Any = g.op(FUSED_NODE, value, *tables, locations, weights)
        batch, _, heads, channels = value.type().sizes()
        queries = locations.type().sizes()[1]
        result.setType(value.type().with_sizes([batch, queries, heads, channels]))
        return result
