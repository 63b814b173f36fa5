"""Routes, ground, signals, occupancy."""

import torch
from torch import Tensor
from torch.nn import functional

from me2e_compress.zoo.highway.map import GAP_SCALE_M, RoadMap
from me2e_compress.zoo.train.targets import Targets

ATTRIBUTE_SCALE = (4.0, 4.0, 4.0, 5.0)
RARE = 4.0
"""Weight of occupied cells: few are."""


def map_losses(road: RoadMap, wanted: Targets) -> dict[str, Tensor]:
    """The commanded route, its attributes, the raster, the signals."""
    rows = torch.arange(len(wanted.command))
    near = torch.linspace(2.0, 0.5, wanted.path.shape[1])[:, None]
    path = wanted.path
    fine = (road.paths[rows, wanted.command] - path).abs() * near
    rough = (road.rough[rows, wanted.command] - path).abs() * near
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
        "path": _capped(fine) + 0.3 * _capped(rough),
        "attributes": ((said - wanted.attributes) / scale).abs().mean(),
        "raster": functional.binary_cross_entropy_with_logits(
            road.raster, wanted.raster
        ),
        "signal": functional.binary_cross_entropy_with_logits(signals[..., 0], there),
        "line": miss.sum() / count,
        "colour": colour / light.sum().clamp(min=1),
    }


def _capped(error: Tensor) -> Tensor:
    """A mean in which no point counts more than 10 m, lest junctions drown lanes."""
    return error.clamp(max=10.0).mean()


def occ_losses(occupancy: Tensor, wanted: Targets) -> dict[str, Tensor]:
    """Cross-entropy of the steps that are known."""
    weight = 1 + (RARE - 1) * wanted.occupancy
    error = functional.binary_cross_entropy_with_logits(
        occupancy, wanted.occupancy, weight, reduction="none"
    ).mean((-1, -2))
    known = wanted.occupancy_known.float()
    return {"occ": (error * known).sum() / known.sum().clamp(min=1)}
