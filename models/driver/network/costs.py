"""Costs of a candidate plan, computed from the outputs of the modules."""

import torch
from torch import Tensor

from models.driver.network.bev_grid import grid_of
from models.driver.network.blocks import sample
from models.driver.network.config import BevArea

DISCS_M = (-1.5, 0.0, 1.5)
"""The ego as three discs along its axis."""
RADIUS_M = 1.25
"""Of each: they cover 2 m of width and a small margin."""
SOFT_M = 0.25
"""How gradually a gap becomes an overlap."""
NEAR_M = 2.0
"""Distance at which nearness has fallen to 1 / e."""
FRONT_M = 2.5
"""From the ego's centre to its front bumper."""


def discs_of(places: Tensor, headings: Tensor) -> Tensor:
    """Return centres [B, K, T, 3, 2] of the ego's discs at places [B, K, T, 2]."""
    axis = torch.stack([headings.cos(), headings.sin()], -1)
    return torch.stack([places + axis * shift for shift in DISCS_M], -2)


def between(steps: Tensor) -> Tensor:
    """Insert the middle of every step, the first from 0: [B, T, N] to [B, 2 T, N]."""
    before = torch.cat([torch.zeros_like(steps[:, :1]), steps[:, :-1]], 1)
    return torch.stack([(before + steps) / 2, steps], 2).flatten(1, 2)


def between_travel(travel: Tensor) -> Tensor:
    """Refine [B, A, M, 6, 2] to every quarter of a second: [B, A, M, 12, 2]."""
    shape = travel.shape[:3]
    finer: Tensor = between(travel.flatten(0, 2)).unflatten(0, shape)
    return finer


def swept(plans: Tensor, headings: Tensor) -> Tensor:
    """Return the ego's discs [B, K, 2 T, 3, 2] every quarter of a second.

    Args:
        plans: [B, K, T, 2].
        headings: [B, K, T].
    """
    fine = between(plans.transpose(1, 2).flatten(2)).unflatten(2, (-1, 2))
    turns = between(headings.transpose(1, 2)).transpose(1, 2)
    return discs_of(fine.transpose(1, 2), turns)


def agent_costs(
    discs: Tensor, boxes: Tensor, score: Tensor, travel: Tensor, modes: Tensor
) -> tuple[Tensor, Tensor]:
    """Return overlap with, and nearness to, the predicted boxes of all agents.

    Args:
        discs: [B, K, 2 T, 3, 2].
        boxes: [B, A, 8], see `Tracks`.
        score: [B, A].
        travel: [B, A, M, 2 T, 2].
        modes: [B, A, M] probabilities.

    Returns:
        ([B, K, 2 T] in [0, 1], the same).
    """
    place = boxes[:, :, None, None, 0:2] + travel
    # [B, 1, 2T, 1, A, M] against [B, K, 2T, 3, 1, 1]
    x, y = (place[..., i].permute(0, 3, 1, 2)[:, None, :, None] for i in (0, 1))
    dx = discs[..., 0, None, None] - x
    dy = discs[..., 1, None, None] - y
    cos, sin = (boxes[:, None, None, None, :, i, None] for i in (4, 5))
    half_length, half_width = (
        boxes[:, None, None, None, :, i, None] / 2 for i in (2, 3)
    )
    forward = ((dx * cos + dy * sin).abs() - half_length).clamp(min=0)
    aside = ((dy * cos - dx * sin).abs() - half_width).clamp(min=0)
    gap = (forward * forward + aside * aside + 1e-4).sqrt().amin(3)
    share = (score[..., None] * modes)[:, None, None]
    overlap = (torch.sigmoid((RADIUS_M - gap) / SOFT_M) * share).sum(-1).amax(-1)
    near = (torch.exp(gap / -NEAR_M) * share).sum(-1).amax(-1)
    return overlap, near


def occupied(discs: Tensor, occupancy: Tensor, area: BevArea) -> Tensor:
    """Return the probability that the ground under the ego is occupied.

    Args:
        discs: [B, K, T, 3, 2].
        occupancy: [B, T, rows, columns] probabilities.
        area: that they cover.

    Returns:
        [B, K, T].
    """
    grid = grid_of(discs, area).transpose(1, 2).flatten(0, 1)
    found = sample(occupancy.flatten(0, 1)[:, None], grid)
    worst = found.amax(-1).squeeze(1).unflatten(0, occupancy.shape[:2])
    taken: Tensor = worst.transpose(1, 2)
    return taken


def ground(discs: Tensor, raster: Tensor, area: BevArea) -> Tensor:
    """Return what is under the ego.

    Args:
        discs: [B, K, T, 3, 2].
        raster: [B, R, rows, columns] probabilities.
        area: that they cover.

    Returns:
        [B, K, T, R] means over the discs.
    """
    found = sample(raster, grid_of(discs, area).flatten(1, 2))
    under: Tensor = found.mean(-1).transpose(1, 2).unflatten(1, discs.shape[1:3])
    return under


def beyond_lines(arc_m: Tensor, gap_m: Tensor) -> Tensor:
    """Return how far the front is past each line: soft [B, K, T, S] in [0, 1].

    Args:
        arc_m: [B, K, T] of the ego's centre.
        gap_m: [B, S] from the ego's centre now to each line.
    """
    return torch.sigmoid(arc_m[..., None] + FRONT_M - gap_m[:, None, None])
