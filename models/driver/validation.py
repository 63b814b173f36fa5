"""Validation: losses and plan displacements on held-out samples."""

import numpy as np
import torch
from torch import Tensor

from models.driver.data import DECISIVE_M, Episodes, Sequences
from models.driver.losses import LampHead
from models.driver.losses.planning_losses import displacement
from models.driver.network.stack import Highway
from models.driver.step import NO_AUGMENTATION, run


@torch.no_grad()
def validate(
    model: Highway,
    lamps: LampHead,
    episodes: Episodes,
    lidar2img: Tensor,
    count: int = 240,
    batch: int = 10,
) -> dict[str, float]:
    """Return mean losses and plan displacements (m) on held-out sequences.

    Args:
        model: in evaluation mode.
        lamps: the extra head.
        episodes: held out.
        lidar2img: [6, 4, 4].
        count: sequences drawn.
        batch: of them at a time.
    """
    rng = np.random.default_rng(0)
    sums: dict[str, float] = {}
    rows = list[Tensor]()
    shifts = list[Tensor]()
    for _ in range(count // batch):
        picked = episodes.draw(rng, batch, Sequences())
        images = episodes.images(picked.ravel())
        images = images.reshape(*picked.shape, *images.shape[1:])
        out = run(
            model,
            lamps,
            images,
            episodes.batch(picked),
            lidar2img,
            rng,
            NO_AUGMENTATION,
        )
        for name, loss in out.losses.items():
            sums[name] = sums.get(name, 0.0) + float(loss)
        rows.append(displacement(out.candidates.best(), out.wanted))
        shifts.append(out.wanted.shift_m)
    away, shift = torch.cat(rows), torch.cat(shifts)
    found = {name: round(value / (count // batch), 4) for name, value in sums.items()}
    found["plan_m"] = round(float(away.mean()), 4)
    decisive = away[shift > DECISIVE_M]
    if len(decisive):
        found["plan_decisive_m"] = round(float(decisive.mean()), 4)
    return found
