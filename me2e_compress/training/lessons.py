"""What one process learns from: its share of the episodes."""

import numpy as np
import torch
from torch import Tensor

from me2e_compress.training.cache import Cache
from me2e_compress.training.data import Episodes, Sequences
from me2e_compress.training.losses import LampHead
from me2e_compress.training.step import Augmentation, run, run_planner
from me2e_compress.zoo.highway.stack import Highway

CACHED = 4
"""The planner alone learns from so many times more samples a step, a part at a time:
what every candidate would meet is large, and is needed only until it is costed."""


class Lessons:
    """Losses of drawn samples."""

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
            augmentation: what is made harder.
        """
        self.episodes, self.lidar2img, self.batch = episodes, lidar2img, batch
        self.sequences, self.augmentation = sequences, augmentation
        self._cache: Cache | None = None

    def freeze(self, model: Highway) -> None:
        """From now on only the planner learns: ask the other modules once."""
        model.eval()
        self._cache = Cache.of(model, self.episodes, self.lidar2img)
        self.episodes.forget_pictures()

    def losses(
        self, model: Highway, lamps: LampHead, rng: np.random.Generator
    ) -> dict[str, Tensor]:
        """Losses by name, not weighted, of samples that ``rng`` draws."""
        torch.manual_seed(int(rng.integers(2**31)))
        if self._cache is not None:
            return self._of_planner(model, self._cache, rng)
        return self._of_all(model, lamps, rng)

    def _of_all(
        self, model: Highway, lamps: LampHead, rng: np.random.Generator
    ) -> dict[str, Tensor]:
        """Losses of all modules on sequences."""
        picked = self.episodes.draw(rng, self.batch, self.sequences)
        images = self.episodes.images(picked.ravel())
        images = images.reshape(*picked.shape, *images.shape[1:])
        batch = self.episodes.batch(picked)
        model.train()
        how = self.augmentation
        return run(model, lamps, images, batch, self.lidar2img, rng, how).losses

    def _of_planner(
        self, model: Highway, cache: Cache, rng: np.random.Generator
    ) -> dict[str, Tensor]:
        """Losses of the planner on what the frozen modules once said."""
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
