"""Losses of the samples that one process draws from its share of the episodes."""

import hashlib
import io
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Self
from zipfile import BadZipFile

import numpy as np
import torch
from torch import Tensor

from me2e_compress.base.atomic import write_bytes
from models.driver.data import Episodes, Indices, Sequences
from models.driver.losses import LampHead
from models.driver.network.interfaces import PlannerInput
from models.driver.network.stack import Highway
from models.driver.step import (
    NO_AUGMENTATION,
    Augmentation,
    pixels_of,
    remember,
    run,
    run_planner,
)

GRIDS = ("raster", "occupancy")
"""Probabilities of whole grids: kept in 256 steps."""
FRAMES = 24
"""Run together when the planner's inputs are cached."""


@dataclass
class PlannerInputCache:
    """One `PlannerInput` a sample: float16, grids as uint8.

    Attributes:
        rows: by field of `PlannerInput`, [N, ...].
    """

    rows: dict[str, Tensor]

    @classmethod
    def of(
        cls, model: Highway, episodes: Episodes, lidar2img: Tensor, folder: Path
    ) -> Self:
        """Run the model over every episode, its memory fed forward.

        Args:
            model: in evaluation mode; its planner is not used.
            episodes: all samples.
            lidar2img: [6, 4, 4].
            folder: gets a file an episode: all of them take longer than the stage that
                needs them, and a stage that was interrupted reads what it finds.
        """
        rows: dict[str, Tensor] = {}
        folder.mkdir(exist_ok=True)
        said = _digest_of(model)
        for last in np.unique(episodes.last):
            picked = np.nonzero(episodes.last == last)[0]
            file = folder / f"{_name_of(episodes, picked, said)}.npz"
            if (found := _read(file)) is None:
                found = _episode(model, episodes, picked, lidar2img)
                content = io.BytesIO()
                arrays = {name: part.numpy() for name, part in found.items()}
                np.savez(content, allow_pickle=False, **arrays)
                write_bytes(file, content.getvalue())
            for name, part in found.items():
                if name not in rows:
                    shape = (len(episodes), *part.shape[1:])
                    rows[name] = torch.empty(shape, dtype=part.dtype)
                rows[name][torch.from_numpy(picked)] = part
        return cls(rows)

    def world(self, picked: Indices) -> PlannerInput:
        """Return the planner's inputs of [B] samples."""
        index = torch.from_numpy(picked)
        found = {}
        for name, rows in self.rows.items():
            part = rows[index].float()
            found[name] = part / 255 if name in GRIDS else part
        return PlannerInput(**found)


def _digest_of(model: Highway) -> bytes:
    """Return a digest of all weights but the planner's."""
    digest = hashlib.sha256()
    for name, value in model.state_dict().items():
        if not name.startswith("planner."):
            digest.update(value.contiguous().numpy().tobytes())
    return digest.digest()


def _name_of(episodes: Episodes, picked: Indices, said: bytes) -> str:
    """Return a digest of the model and of what it reads of an episode."""
    digest = hashlib.sha256(said)
    for name in ("time_us", "pose", "can_bus", "command"):
        digest.update(episodes.tables[name][picked].tobytes())
    for index in picked:
        digest.update(episodes.pictures[index].tobytes())
    return digest.hexdigest()


def _read(file: Path) -> dict[str, Tensor] | None:
    """Return what a file holds; None if it is not there or damaged."""
    try:
        with file.open("rb") as source, np.load(source) as content:
            return {name: torch.from_numpy(content[name]) for name in content}
    except (OSError, EOFError, ValueError, BadZipFile):
        return None


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
            fine, middle = model.look(pixels_of(part, rng, NO_AUGMENTATION))
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


CACHED = 4
"""The planner alone learns from this many times more samples a step, a part at a time:
the costs of all candidates take much memory, and only until they are summed."""


class SampledLosses:
    """Draws samples and computes their losses."""

    def __init__(
        self,
        episodes: Episodes,
        lidar2img: Tensor,
        batch: int,
        sequences: Sequences,
        augmentation: Augmentation,
    ) -> None:
        """Keep what is learned from.

        Args:
            episodes: of this process.
            lidar2img: [6, 4, 4].
            batch: sequences a step.
            sequences: how they are drawn.
            augmentation: of the samples.
        """
        self.episodes, self.lidar2img, self.batch = episodes, lidar2img, batch
        self.sequences, self.augmentation = sequences, augmentation
        self._cache: PlannerInputCache | None = None

    def freeze(self, model: Highway, folder: Path) -> None:
        """Freeze all modules but the planner: run the others once, and cache.

        Args:
            model: the stack.
            folder: for the cache, see `PlannerInputCache.of`.
        """
        model.eval()
        episodes, lidar2img = self.episodes, self.lidar2img
        self._cache = PlannerInputCache.of(model, episodes, lidar2img, folder)
        self.episodes.forget_pictures()

    def draw(
        self, model: Highway, lamps: LampHead, rng: np.random.Generator
    ) -> dict[str, Tensor]:
        """Draw samples with ``rng`` and return their losses by name, not weighted."""
        torch.manual_seed(int(rng.integers(2**31)))
        if self._cache is not None:
            return self._of_planner(model, self._cache, rng)
        return self._of_all(model, lamps, rng)

    def _of_all(
        self, model: Highway, lamps: LampHead, rng: np.random.Generator
    ) -> dict[str, Tensor]:
        """Return the losses of all modules on sequences."""
        picked = self.episodes.draw(rng, self.batch, self.sequences)
        images = self.episodes.images(picked.ravel())
        images = images.reshape(*picked.shape, *images.shape[1:])
        batch = self.episodes.batch(picked)
        model.train()
        how = self.augmentation
        return run(model, lamps, images, batch, self.lidar2img, rng, how).losses

    def _of_planner(
        self, model: Highway, cache: PlannerInputCache, rng: np.random.Generator
    ) -> dict[str, Tensor]:
        """Return the losses of the planner on the cached outputs of the others."""
        count = self.batch * self.sequences.length * CACHED
        picked = self.episodes.draw(rng, count, Sequences(length=1))[:, 0]
        model.eval()
        model.planner.train()
        parts = [
            run_planner(
                model,
                cache.world(part),
                self.episodes.rows(part),
                rng,
                self.augmentation,
            )
            for part in np.array_split(picked, CACHED)
        ]
        return {
            name: torch.stack([part[name] for part in parts]).mean()
            for name in parts[0]
        }
