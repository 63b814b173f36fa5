"""Boxes and futures."""

import torch
from torch import Tensor
from torch.nn import functional

from me2e_compress.training.labels import Targets
from me2e_compress.training.losses.focal import focal
from me2e_compress.zoo.highway.config import BevArea
from me2e_compress.zoo.highway.motion import Futures
from me2e_compress.zoo.highway.track import Tracks

HALO = 0.7
"""How far the eight cells around an agent's are forgiven."""
SPEED_STEP_MPS = 2.0
"""An error of the velocity counts in steps of this, beside metres of the place: over
the 3 s of a plan, 2 m/s are more than a car's length."""
NEAR_M = 4.0
"""A query this far from an agent cannot be its."""


def match(tracks: Tracks, wanted: Targets) -> tuple[Tensor, Tensor]:
    """Give every agent its nearest query.

    Returns:
        (int64 [B, Q] agent of each query, bool [B, Q] whether it has one).
    """
    place = tracks.boxes[..., :2].detach()
    away = (place[:, :, None] - wanted.agents[:, None, :, 1:3]).norm(dim=-1)
    away = away.masked_fill(~wanted.there[:, None], torch.inf)
    best, query = away.min(1)
    owner = torch.full(place.shape[:2], -1, dtype=torch.int64)
    taken = torch.full(place.shape[:2], torch.inf)
    for agent in range(best.shape[1]):
        mine, where = best[:, agent], query[:, agent]
        held = taken.gather(1, where[:, None])[:, 0]
        wins = (mine < NEAR_M) & (mine < held)
        rows = wins.nonzero()[:, 0]
        owner[rows, where[rows]] = agent
        taken[rows, where[rows]] = mine[rows]
    return owner.clamp(min=0), owner >= 0


def track_losses(
    tracks: Tracks, wanted: Targets, area: BevArea, owner: Tensor, mine: Tensor
) -> dict[str, Tensor]:
    """Detection map, presence, boxes, classes."""
    peaks = torch.zeros(tracks.heat.shape)
    peaks = peaks.scatter_add(1, wanted.cells, wanted.there.float()).clamp(max=1)
    grid = peaks.unflatten(1, (1, area.rows, area.columns))
    halo = functional.max_pool2d(grid, 3, 1, 1).flatten(1) * HALO
    picked = _pick(wanted.agents, owner)[mine]
    boxes = tracks.boxes[mine]
    aims = torch.stack(
        [
            *(picked[:, 1], picked[:, 2], picked[:, 5].log(), picked[:, 6].log()),
            *(picked[:, 3], picked[:, 4]),
            *(picked[:, 7] / SPEED_STEP_MPS, picked[:, 8] / SPEED_STEP_MPS),
        ],
        -1,
    )
    said = torch.cat(
        [
            boxes[:, :2],
            boxes[:, 2:4].log(),
            boxes[:, 4:6],
            boxes[:, 6:8] / SPEED_STEP_MPS,
        ],
        -1,
    )
    count = mine.sum().clamp(min=1)
    return {
        "heat": focal(tracks.heat.float(), peaks, halo),
        "score": functional.binary_cross_entropy_with_logits(
            tracks.logits, mine.float()
        ),
        "box": functional.smooth_l1_loss(said, aims, reduction="sum") / count,
        "class": functional.cross_entropy(
            tracks.classes[mine].float(), picked[:, 0].long(), reduction="sum"
        )
        / count,
    }


def motion_losses(
    futures: Futures, wanted: Targets, owner: Tensor, mine: Tensor
) -> dict[str, Tensor]:
    """The best mode learns, and is to be the likeliest."""
    known = _pick(wanted.travel_known.float(), owner)[mine]
    aims = _pick(wanted.travel.flatten(2), owner)[mine].unflatten(-1, (-1, 2))
    said, logits = futures.travel[mine], futures.logits[mine]
    away = (said - aims[:, None]).norm(dim=-1) * known[:, None]
    best = away.detach().sum(-1).argmin(1)
    rows = torch.arange(len(best))
    error = functional.smooth_l1_loss(said[rows, best], aims, reduction="none")
    seen = known.any(-1).float()
    total = (error.sum(-1) * known).sum() / known.sum().clamp(min=1)
    choice = functional.cross_entropy(logits, best, reduction="none")
    return {
        "travel": total,
        "mode": (choice * seen).sum() / seen.sum().clamp(min=1),
    }


def _pick(rows: Tensor, index: Tensor) -> Tensor:
    return rows.gather(1, index[..., None].expand(-1, -1, rows.shape[-1]))
