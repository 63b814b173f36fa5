"""Places of the cells, and routes built from headings."""

import torch
from torch import Tensor

from models.driver.network.config import PATH_STEP_M, BevArea


def cell_centres(area: BevArea) -> Tensor:
    """Return [rows * columns, 2], x and y of every cell, metres, ego frame."""
    x = area.front_m - area.cell_m * (torch.arange(area.rows) + 0.5)
    y = area.left_m - area.cell_m * (torch.arange(area.columns) + 0.5)
    return torch.stack(torch.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)


def grid_of(points: Tensor, area: BevArea) -> Tensor:
    """Convert ego-frame points [..., 2] to (column, row) in [-1, 1]."""
    height = area.cell_m * area.rows
    width = area.cell_m * area.columns
    across = (area.left_m - points[..., 1]) * (2 / width) - 1
    down = (area.front_m - points[..., 0]) * (2 / height) - 1
    return torch.stack([across, down], -1)


def route_points(lateral: Tensor, headings: Tensor) -> Tensor:
    """Return the points of a route, `PATH_STEP_M` apart, from beside the ego on.

    Args:
        lateral: [...] metres that the ego is left of the route.
        headings: [..., P] radians relative to the ego, at each point.

    Returns:
        [..., P, 2] metres in the ego frame.
    """
    cos, sin = headings.cos(), headings.sin()
    step = PATH_STEP_M / 2
    dx = (cos[..., 1:] + cos[..., :-1]) * step
    dy = (sin[..., 1:] + sin[..., :-1]) * step
    start = torch.stack([lateral * sin[..., 0], -lateral * cos[..., 0]], -1)
    ahead = torch.stack([dx, dy], -1).cumsum(-2)
    return torch.cat([start[..., None, :], start[..., None, :] + ahead], -2)
