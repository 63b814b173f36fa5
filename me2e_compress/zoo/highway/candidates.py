"""Candidate plans: speed profiles and offsets along the commanded route."""

import torch
from torch import Tensor

from me2e_compress.zoo.highway.config import PATH_STEP_M


def hats(arc_m: Tensor, points: int) -> Tensor:
    """Weights [..., P] that interpolate linearly between the points of a route."""
    knots = torch.arange(points, device=arc_m.device, dtype=arc_m.dtype)
    return (1 - (arc_m[..., None] / PATH_STEP_M - knots).abs()).clamp(min=0)


def along(
    arc_m: Tensor, offset_m: Tensor, path: Tensor, headings: Tensor
) -> tuple[Tensor, Tensor]:
    """Places beside a route.

    Args:
        arc_m: [B, K, T] metres along it, 0 to its length.
        offset_m: [B, K, T] metres to the left of it.
        path: [B, P, 2].
        headings: [B, P].

    Returns:
        ([B, K, T, 2] metres in the ego frame, [B, K, T] headings).
    """
    weights = hats(arc_m, path.shape[1])
    shape = weights.shape[:3]
    flat = weights.flatten(1, 2)
    table = torch.cat([path, headings[..., None]], -1)
    found = torch.matmul(flat, table).unflatten(1, shape[1:])
    heading = found[..., 2]
    left = torch.stack([-heading.sin(), heading.cos()], -1)
    return found[..., :2] + offset_m[..., None] * left, heading
