"""Reference points: pillars in the images, and the previous BEV in the current one."""

import math

import torch
from torch import Tensor

from models.bev.sampling import sample
from models.bev.sizes import BevGrid, Sampling

MIN_DEPTH = torch.tensor(1.0e-5)
"""Metres (BEVFormer, ``point_sampling``). A tensor: the exporter would write a Python
number as float64."""


def pillars(hw: tuple[int, int], pc_range: tuple[float, ...], heights: int) -> Tensor:
    """Return points above the cell centres: [heights, cells, 4, 1], x y z 1, metres."""
    low, high = torch.tensor(pc_range[:3]), torch.tensor(pc_range[3:])
    counts = (heights, hw[0], hw[1])
    z, y, x = torch.meshgrid(
        *((torch.arange(count) + 0.5) / count for count in counts), indexing="ij"
    )
    metres = torch.stack([x, y, z], -1).flatten(1, 2) * (high - low) + low
    return torch.cat([metres, torch.ones_like(metres[..., :1])], -1).unsqueeze(-1)


def cell_centres(hw: tuple[int, int]) -> Tensor:
    """Return the centres of the cells of a grid, [1, cells, 2]: x and y, 0..1."""
    rows, columns = torch.meshgrid(
        *((torch.arange(count) + 0.5) / count for count in hw), indexing="ij"
    )
    return torch.stack([columns, rows], -1).view(1, -1, 2)


def project(
    points: Tensor, lidar2img: Tensor, image_hw: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Project pillars [heights, cells, 4, 1] into the cameras.

    ``lidar2img`` [1, cameras, 4, 4] maps metres to pixels times depth. Returns
    positions [cameras, cells, heights, 2], 0..1 within the image, and float32 [cameras,
    cells, 1]: 1 where a camera sees any point of the pillar.
    """
    seen = torch.matmul(lidar2img[0][:, None, None], points.unsqueeze(0)).squeeze(-1)
    # Divide by depth, and scale to 0..1
    depth = seen[..., 2:3]
    uv = seen[..., :2] / torch.maximum(depth, MIN_DEPTH)
    u, v = uv[..., 0:1] / image_hw[1], uv[..., 1:2] / image_hw[0]
    # Visible: in front of the camera and within the image
    inside = (depth > MIN_DEPTH) & (u > 0) & (u < 1) & (v > 0) & (v < 1)
    visible = inside.to(uv.dtype).amax(1)
    return torch.cat([u, v], -1).transpose(1, 2), visible


def ego_shift(can_bus: Tensor, grid: BevGrid) -> Tensor:
    """Return the last frame's translation relative to the BEV grid, [1, 2] (x, y).

    ``can_bus`` [18] holds dx and dy in metres (world) at 0 and 1 and the yaw in radians
    at 16. The original takes length t and angle of the translation (dx, dy), then y = t
    cos(ego - angle), x = t sin(ego - angle). Expanding the differences needs neither
    square root nor arc tangent: y = cos(ego) dx + sin(ego) dy, x = sin(ego) dx -
    cos(ego) dy.
    """
    dx, dy, yaw = can_bus[0:1], can_bus[1:2], can_bus[16:17]
    cos, sin = torch.cos(yaw), torch.sin(yaw)
    low_x, low_y, _, high_x, high_y, _ = grid.pc_range
    right = (sin * dx - cos * dy) / (high_x - low_x)
    ahead = (cos * dx + sin * dy) / (high_y - low_y)
    return torch.stack([right, ahead], -1)


def cell_positions(grid: BevGrid) -> Tensor:
    """Return [cells, 2], the BEV's pixel centres relative to the rotation centre."""
    rows, columns = torch.meshgrid(
        torch.arange(grid.hw[0]) + 0.5, torch.arange(grid.hw[1]) + 0.5, indexing="ij"
    )
    return torch.stack([columns, rows], -1).view(-1, 2) - torch.tensor(
        grid.rotation_centre
    )


def turn(
    bev: Tensor, can_bus: Tensor, cells: Tensor, grid: BevGrid, sampling: Sampling
) -> Tensor:
    """Rotate the previous BEV [cells, 1, 256] to the current heading, nearest cell.

    The last of ``can_bus`` [18] is the change of yaw in degrees; ``cells`` [cells, 2]
    are from `cell_positions`. Returns [1, cells, 256].
    """
    height, width = grid.hw
    centre_column, centre_row = grid.rotation_centre
    # Rotate the cell positions
    angle = can_bus[17:18] * (math.pi / 180)
    cos, sin = torch.cos(angle), torch.sin(angle)
    x, y = cells[:, 0], cells[:, 1]
    column = cos * x - sin * y + centre_column
    row = sin * x + cos * y + centre_row
    # Sample the previous view there
    at = torch.stack([column * (2 / width) - 1, row * (2 / height) - 1], -1)
    image = bev.permute(1, 2, 0).view(1, -1, height, width)
    turned = sample(image, at.view(1, height, width, 2), sampling, mode="nearest")
    return turned.flatten(2).transpose(1, 2)
