"""Reference points: pillars in the images, the previous BEV under the present one."""

import math

import torch
from torch import Tensor

from me2e_compress.zoo.vad.config import BEV_HW, PC_RANGE, ROTATION_CENTRE, Sampling
from me2e_compress.zoo.vad.sampling import sample

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


def project(
    points: Tensor, lidar2img: Tensor, image_hw: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Project pillars into the cameras.

    Args:
        points: [heights, cells, 4, 1] from `pillars`.
        lidar2img: [1, cameras, 4, 4], metres to pixels times depth.
        image_hw: Pixels.

    Returns:
        Positions [cameras, cells, heights, 2], 0..1 inside of the image, and float32
        [cameras, cells, 1]: 1 where a camera sees any point of the pillar.
    """
    seen = torch.matmul(lidar2img[0][:, None, None], points.unsqueeze(0)).squeeze(-1)
    depth = seen[..., 2:3]
    uv = seen[..., :2] / torch.maximum(depth, MIN_DEPTH)
    u, v = uv[..., 0:1] / image_hw[1], uv[..., 1:2] / image_hw[0]
    inside = (depth > MIN_DEPTH) & (u > 0) & (u < 1) & (v > 0) & (v < 1)
    visible = inside.to(uv.dtype).amax(1)
    return torch.cat([u, v], -1).transpose(1, 2), visible


def ego_shift(can_bus: Tensor) -> Tensor:
    """Return the last frame's translation as a part of the BEV grid, [1, 2] (x, y).

    The original takes length t and angle of the translation (dx, dy) and then
    y = t cos(ego - angle), x = t sin(ego - angle). Expanding the differences needs
    neither square root nor arc tangent: y = cos(ego) dx + sin(ego) dy and
    x = sin(ego) dx - cos(ego) dy.

    Args:
        can_bus: [18]; 0 and 1 are dx and dy in metres (world), 16 the yaw in radians.
    """
    dx, dy, yaw = can_bus[0:1], can_bus[1:2], can_bus[16:17]
    cos, sin = torch.cos(yaw), torch.sin(yaw)
    right = (sin * dx - cos * dy) / (PC_RANGE[3] - PC_RANGE[0])
    ahead = (cos * dx + sin * dy) / (PC_RANGE[4] - PC_RANGE[1])
    return torch.stack([right, ahead], -1)


def cell_positions() -> Tensor:
    """Return [cells, 2], the BEV's pixel centres relative to the rotation centre."""
    rows, columns = torch.meshgrid(
        torch.arange(BEV_HW[0]) + 0.5, torch.arange(BEV_HW[1]) + 0.5, indexing="ij"
    )
    return torch.stack([columns, rows], -1).view(-1, 2) - torch.tensor(ROTATION_CENTRE)


def turn(bev: Tensor, can_bus: Tensor, cells: Tensor, sampling: Sampling) -> Tensor:
    """Rotate the previous BEV to the present heading, to the nearest cell.

    Args:
        bev: [cells, 1, 256].
        can_bus: [18]; the last is the change of yaw in degrees.
        cells: [cells, 2] from `cell_positions`.
        sampling: See `sample`.

    Returns:
        [1, cells, 256].
    """
    height, width = BEV_HW
    angle = can_bus[17:18] * (math.pi / 180)
    cos, sin = torch.cos(angle), torch.sin(angle)
    x, y = cells[:, 0], cells[:, 1]
    column = cos * x - sin * y + ROTATION_CENTRE[0]
    row = sin * x + cos * y + ROTATION_CENTRE[1]
    grid = torch.stack([column * (2 / width) - 1, row * (2 / height) - 1], -1)
    image = bev.permute(1, 2, 0).view(1, -1, height, width)
    turned = sample(image, grid.view(1, height, width, 2), sampling, mode="nearest")
    return turned.flatten(2).transpose(1, 2)
