"""Losses of the routes, the ground, the signals and the occupancy."""

import torch
from torch import Tensor
from torch.nn import functional

from models.driver.label_tensors import Labels
from models.driver.network.map import GAP_SCALE_M, RoadMap

ATTRIBUTE_SCALE = (4.0, 4.0, 4.0, 5.0)
"""What each attribute's error is measured in: three widths in wide lanes (m), the
speed in steps of 5 m/s."""
FAR_M = 5.0
"""Beyond this a point of a route is far off, and farther is hardly worse."""
NEAR_WEIGHT, FAR_WEIGHT = 2.0, 0.5
"""Of the first and the last point of a route: the next plan drives on the first."""
ROUGH = 0.3
"""Share of the route before it is refined."""
RARE = 4.0
"""Weight of occupied cells: few are."""


def map_losses(road: RoadMap, wanted: Labels) -> dict[str, Tensor]:
    """Return the losses of route, attributes, raster and signals."""
    rows = torch.arange(len(wanted.command))
    near = torch.linspace(NEAR_WEIGHT, FAR_WEIGHT, wanted.path.shape[1])[:, None]
    path = wanted.path
    fine = _soft((road.paths[rows, wanted.command] - path).abs()) * near
    rough = _soft((road.rough[rows, wanted.command] - path).abs()) * near
    scale = torch.tensor(ATTRIBUTE_SCALE)
    said = road.attributes[rows, wanted.command]
    there, gap, state = wanted.signals.unbind(-1)
    signals = road.signals
    light = state[:, 0] >= 0
    count = there.sum().clamp(min=1)
    miss = (signals[..., 1] - gap / GAP_SCALE_M).abs() * there
    colour = functional.cross_entropy(
        signals[:, 0, 2:][light], state[:, 0][light].long(), reduction="sum"
    )
    return {
        "path": fine.mean() + ROUGH * rough.mean(),
        "heading": _turned(road.headings[rows, wanted.command], path),
        "attributes": ((said - wanted.attributes) / scale).abs().mean(),
        "raster": functional.binary_cross_entropy_with_logits(
            road.raster, wanted.raster
        ),
        "signal": functional.binary_cross_entropy_with_logits(signals[..., 0], there),
        "line": miss.sum() / count,
        "colour": colour / light.sum().clamp(min=1),
    }


def _soft(error: Tensor) -> Tensor:
    """Compress errors beyond `FAR_M`, lest junctions outweigh lanes."""
    return FAR_M * torch.log1p(error / FAR_M)


def _turned(headings: Tensor, path: Tensor) -> Tensor:
    """Return the mean angle (rad) between a route [B, P] and a path [B, P, 2]."""
    chords = path[:, 1:] - path[:, :-1]
    wanted = torch.atan2(chords[..., 1], chords[..., 0])
    said = (headings[:, 1:] + headings[:, :-1]) / 2
    away = said - wanted
    return torch.atan2(away.sin(), away.cos()).abs().mean()


def occ_losses(occupancy: Tensor, wanted: Labels) -> dict[str, Tensor]:
    """Return the cross-entropy of the steps that are known."""
    weight = 1 + (RARE - 1) * wanted.occupancy
    error = functional.binary_cross_entropy_with_logits(
        occupancy, wanted.occupancy, weight, reduction="none"
    ).mean((-1, -2))
    known = wanted.occupancy_known.float()
    return {"occ": (error * known).sum() / known.sum().clamp(min=1)}
