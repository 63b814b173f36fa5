"""Sines and cosines of positions (Vaswani et al. 2017)."""

import math

import torch
from torch import Tensor, nn

from models.bev.sizes import EMBED

TEMPERATURE = 10_000.0
HALF = EMBED // 2
"""Size of the embedding of one coordinate."""


def _divisors() -> Tensor:
    return TEMPERATURE ** (torch.arange(0, HALF, 2) / HALF)


def _waves(at: Tensor, divisors: Tensor) -> Tensor:
    """Map coordinates [...] in 0..2 pi to alternating sine and cosine, [..., 128]."""
    angles = at.unsqueeze(-1) / divisors
    return torch.stack([angles.sin(), angles.cos()], -1).flatten(-2)


class CellSines(nn.Module):
    """A fixed embedding of rows and columns (DETR, offset by half a cell)."""

    def __init__(self, hw: tuple[int, int]) -> None:
        super().__init__()
        self.hw = hw
        for name, count in (("rows", hw[0]), ("columns", hw[1])):
            at = (torch.arange(count) + 0.5) / count * (2 * math.pi)
            # saved, as else the tracer would write what comes of them, 41 MB twice
            self.register_buffer(name, _waves(at, _divisors()))

    rows: Tensor
    columns: Tensor

    def forward(self) -> Tensor:
        """Return [1, cells, 256]: row half, then column half."""
        height, width = self.hw
        rows = self.rows.unsqueeze(1).expand(-1, width, -1)
        columns = self.columns.unsqueeze(0).expand(height, -1, -1)
        return torch.cat([rows, columns], -1).flatten(0, 1).unsqueeze(0)


class PointSines(nn.Module):
    """Embeds points in metres; ``pc_range`` is x, y, z minima then maxima."""

    def __init__(self, pc_range: tuple[float, ...]) -> None:
        super().__init__()
        low, high = torch.tensor(pc_range[:2]), torch.tensor(pc_range[3:5])
        self.register_buffer("low", low, False)
        self.register_buffer("circle", 2 * math.pi / (high - low), False)
        self.register_buffer("divisors", _divisors(), False)

    low: Tensor
    circle: Tensor
    divisors: Tensor

    def forward(self, points: Tensor) -> Tensor:
        """Map [..., 2] (x, y) to [..., 256]: y half, then x half."""
        at = (points - self.low) * self.circle
        swapped = torch.stack([at[..., 1], at[..., 0]], -1)
        return _waves(swapped, self.divisors).flatten(-2)
