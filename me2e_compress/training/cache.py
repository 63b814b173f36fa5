"""What the frozen modules say of every sample, so that the planner learns fast."""

from dataclasses import dataclass, fields
from typing import Self

import numpy as np
import torch
from torch import Tensor

from me2e_compress.training.data import Episodes, Indices
from me2e_compress.training.step import NONE, pixels_of, remember
from me2e_compress.zoo.highway.interfaces import PlannerInput
from me2e_compress.zoo.highway.stack import Highway

GRIDS = ("raster", "occupancy")
"""Probabilities of whole grids: kept in 256 steps."""
FRAMES = 24
"""Looked at together."""


@dataclass
class Cache:
    """One `PlannerInput` a sample: float16, grids as uint8.

    Attributes:
        rows: by field of `PlannerInput`, [N, ...].
    """

    rows: dict[str, Tensor]

    @classmethod
    def of(cls, model: Highway, episodes: Episodes, lidar2img: Tensor) -> Self:
        """Run the model over every episode, its memory fed forward.

        Args:
            model: in evaluation mode; its planner is not used.
            episodes: all samples.
            lidar2img: [6, 4, 4].
        """
        rows: dict[str, Tensor] = {}
        for last in np.unique(episodes.last):
            picked = np.nonzero(episodes.last == last)[0]
            for name, part in _episode(model, episodes, picked, lidar2img).items():
                if name not in rows:
                    shape = (len(episodes), *part.shape[1:])
                    rows[name] = torch.empty(shape, dtype=part.dtype)
                rows[name][torch.from_numpy(picked)] = part
        return cls(rows)

    def world(self, picked: Indices) -> PlannerInput:
        """The worlds of [B] samples."""
        index = torch.from_numpy(picked)
        found = {}
        for name, rows in self.rows.items():
            part = rows[index].float()
            found[name] = part / 255 if name in GRIDS else part
        return PlannerInput(**found)


@torch.no_grad()
def _episode(
    model: Highway,
    episodes: Episodes,
    picked: Indices,
    lidar2img: Tensor,
) -> dict[str, Tensor]:
    batch = episodes.batch(picked[None])
    rng = np.random.default_rng(0)
    command = torch.from_numpy(np.asarray(batch["command"][0], np.int64))
    looks, middles = list[Tensor](), list[Tensor]()
    with torch.autocast("cpu", torch.bfloat16):
        for begin in range(0, len(picked), FRAMES):
            part = episodes.images(picked[begin : begin + FRAMES])[None]
            fine, middle = model.look(pixels_of(part, rng, NONE))
            calibration = lidar2img.expand(part.shape[1], -1, -1, -1)
            looks.append(model.bev_encoder.look(fine, calibration).float())
            middles.append(middle)
        joined = remember(model, torch.cat(looks), batch)
        worlds = list[PlannerInput]()
        for number, middle in enumerate(middles):
            where = slice(number * FRAMES, (number + 1) * FRAMES)
            bev = model.bev_encoder.fuse(joined[where])
            seen = model.understand(bev, model.bev_encoder.tokens(bev), middle)
            worlds.append(model.world(seen, command[where]))
    return {
        field.name: _packed(
            field.name, torch.cat([getattr(world, field.name) for world in worlds])
        )
        for field in fields(PlannerInput)
    }


def _packed(name: str, value: Tensor) -> Tensor:
    if name in GRIDS:
        return (value.float() * 255).round().to(torch.uint8)
    return value.half()
