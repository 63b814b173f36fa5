"""Labels of every module as tensors."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from me2e_compress.simulator.scene import PixelClass
from models.driver.network.config import SIGNAL_KINDS, BevArea
from models.driver.stored_episode import Array

SIGNAL_SEEN_M = (-3.0, 40.0)
"""A signal is there if its line is this far from the ego's centre: a lamp farther than
that is under two pixels wide, and behind the front axle it no longer matters."""
WIDEST_M = 12.0
"""More free road to a side than three lanes is as good as three lanes."""
ROAD = (
    PixelClass.DRIVABLE,
    PixelClass.LANE_MARKING,
    PixelClass.STOP_LINE,
    PixelClass.CROSSWALK,
)
"""What a lane is made of."""


@dataclass
class Labels:
    """Labels of B samples.

    Attributes:
        agents: [B, A, 10] class (-1 none), x, y, cos, sin, length, width, vx, vy,
            braking.
        there: [B, A] bool.
        cells: int64 [B, A] the cell of each agent.
        travel: [B, A, 6, 2] metres from where it is now; 0 where unknown.
        travel_known: [B, A, 6] bool.
        path: [B, P, 2].
        attributes: [B, P, 4].
        command: int64 [B].
        raster: [B, 4, H, W] 0 or 1.
        signals: [B, 3, 3] there (0 or 1), metres to the line, state (-1 none).
        lamps: [B, S, 8] the signals as recorded.
        occupancy: [B, 6, H, W] 0 or 1.
        occupancy_known: [B, 6] bool.
        moves: [B, 6, 2] the expert's plan: metres along the route, metres to the left
            of where the ego is beside it.
        plan: [B, 6, 2] the same in the ego frame.
        shift_m: [B] how much the actors change it.
    """

    agents: Tensor
    there: Tensor
    cells: Tensor
    travel: Tensor
    travel_known: Tensor
    path: Tensor
    attributes: Tensor
    command: Tensor
    raster: Tensor
    signals: Tensor
    lamps: Tensor
    occupancy: Tensor
    occupancy_known: Tensor
    moves: Tensor
    plan: Tensor
    shift_m: Tensor


def labels_of(batch: dict[str, Array], area: BevArea) -> Labels:
    """Turn recorded arrays [B, ...] into labels."""
    agents = torch.from_numpy(np.asarray(batch["agents"], np.float32))
    futures = torch.from_numpy(np.asarray(batch["futures"], np.float32))
    known = ~futures.isnan().any(-1)
    travel = torch.nan_to_num(futures - agents[:, :, None, 1:3])
    row = ((area.front_m - agents[..., 1]) / area.cell_m).long()
    column = ((area.left_m - agents[..., 2]) / area.cell_m).long()
    row, column = row.clamp(0, area.rows - 1), column.clamp(0, area.columns - 1)
    ground = torch.from_numpy(np.asarray(batch["ground"], np.uint8))
    bits = np.unpackbits(np.asarray(batch["occupancy"], np.uint8), axis=-1)
    shape = (*bits.shape[:2], 2 * area.rows, 2 * area.columns)
    steps = torch.from_numpy(np.asarray(batch["known_steps"], np.int64))
    attributes = _tensor(batch["path_attributes"])
    attributes[..., :3].clamp_(max=WIDEST_M)
    return Labels(
        agents,
        agents[..., 0] >= 0,
        row * area.columns + column,
        travel,
        known & (agents[..., 0] >= 0)[..., None],
        _tensor(batch["path"]),
        attributes,
        torch.from_numpy(np.asarray(batch["command"], np.int64)),
        raster_of(ground),
        signals_of(_tensor(batch["signals"])),
        _tensor(batch["signals"]),
        torch.from_numpy(bits.reshape(shape)).float(),
        torch.arange(bits.shape[1])[None] < steps[:, None],
        _tensor(batch["moves"]),
        _tensor(batch["plan"]),
        _tensor(batch["shift_m"]),
    )


def raster_of(ground: Tensor) -> Tensor:
    """Convert `PixelClass` [B, H, W] to road, shoulder, marking, stop line."""
    layers = [
        torch.isin(ground, torch.tensor(ROAD)),
        ground == PixelClass.SHOULDER,
        ground == PixelClass.LANE_MARKING,
        ground == PixelClass.STOP_LINE,
    ]
    return torch.stack(layers, 1).float()


def signals_of(signals: Tensor) -> Tensor:
    """Return the nearest signal of each kind on the route: [B, S, 8] to [B, 3, 3]."""
    gap = signals[..., 6]
    low, high = SIGNAL_SEEN_M
    found = torch.zeros(len(signals), SIGNAL_KINDS, 3)
    found[..., 2] = -1
    for kind in range(SIGNAL_KINDS):
        mine = (signals[..., 0] == kind) & (gap > low) & (gap < high)
        near = torch.where(mine, gap, torch.inf)
        best, index = near.min(1)
        there = best.isfinite()
        state = signals[..., 1].gather(1, index[:, None])[:, 0]
        found[:, kind, 0] = there.float()
        found[:, kind, 1] = torch.where(there, best, 0.0)
        found[:, kind, 2] = torch.where(there, state, -1.0)
    return found


def _tensor(array: Array) -> Tensor:
    return torch.from_numpy(np.array(array, np.float32))
