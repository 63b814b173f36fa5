"""Episodes in memory, and short sequences drawn from them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from me2e_compress.errors import TrainingError
from me2e_compress.zoo.highway.config import CAMERAS
from me2e_compress.zoo.train.episodes import decode
from me2e_compress.zoo.train.frenet import project

Array = npt.NDArray[np.generic]
Floats = npt.NDArray[np.floating]

KEPT = (
    "time_us",
    "pose",
    "can_bus",
    "command",
    "rest_s",
    "plan",
    "plan_alone",
    "path",
    "path_attributes",
    "lateral_m",
    "agents",
    "futures",
    "signals",
    "ground",
    "occupancy",
    "known_steps",
)
"""Arrays of an episode that training reads, one row a sample."""


@dataclass(frozen=True)
class Sequences:
    """How sequences are drawn.

    Attributes:
        length: samples of a sequence; the memory of the model begins empty.
        strides: distances between them, in stored samples.
    """

    length: int = 3
    strides: tuple[int, ...] = (1, 2)


class Episodes:
    """Everything of some episodes, pictures still compressed."""

    def __init__(self, files: Sequence[Path], image_size: tuple[int, int]) -> None:
        """Read episodes.

        Args:
            files: one an episode.
            image_size: rows and columns of a camera that the model sees.

        Raises:
            TrainingError: there is none, one is not an episode, or its cameras are
                laid out otherwise.
        """
        self.image_size = image_size
        tables: dict[str, list[Array]] = {name: [] for name in KEPT}
        self.pictures: list[npt.NDArray[np.uint8]] = []
        lengths = list[int]()
        for file in files:
            lengths.append(self._read(file, tables))
        if not lengths:
            raise TrainingError("there is no episode to learn from")
        self.tables = {name: np.concatenate(rows) for name, rows in tables.items()}
        ends = np.cumsum(lengths)
        self.last = np.repeat(ends - 1, lengths)
        self.moves = project(self.tables["plan"], self.tables["path"])
        self.moves[..., 1] -= self.tables["lateral_m"][:, None]
        shift = np.linalg.norm(self.tables["plan"] - self.tables["plan_alone"], axis=-1)
        self.shift_m = shift.mean(-1)

    def _read(self, file: Path, tables: dict[str, list[Array]]) -> int:
        try:
            with np.load(file) as content:
                for name in KEPT:
                    tables[name].append(content[name])
                offsets, data = content["jpeg_offsets"], content["jpeg"]
        except (OSError, ValueError, KeyError) as error:
            raise TrainingError(f"{file}: not an episode: {error}") from error
        cuts = zip(offsets, offsets[1:], strict=False)
        pictures = [data[begin:end].copy() for begin, end in cuts]
        found = decode(pictures[0]).shape
        if found != (CAMERAS, *self.image_size, 3):
            wanted = "x".join(map(str, self.image_size))
            raise TrainingError(
                f"{file}: its cameras have {found[1]}x{found[2]} pixels, the model "
                f"sees {wanted}: collect again"
            )
        self.pictures += pictures
        return len(pictures)

    def __len__(self) -> int:
        """Count the samples."""
        return len(self.last)

    def departures(self) -> Floats:
        """[N, 6, 2] the expert's plans less going on at the speed of now."""
        times = 0.5 * np.arange(1, self.moves.shape[1] + 1)
        speed = self.tables["can_bus"][:, 7, None]
        coasting = np.stack([speed * times, np.zeros_like(speed * times)], -1)
        return self.moves - coasting

    @cached_property
    def weights(self) -> Floats:
        """How often a sample is drawn: more where the actors or a signal decide."""
        command = self.tables["command"]
        signals = self.tables["signals"]
        line = (signals[..., 0] >= 0) & (np.abs(signals[..., 6]) < 25)
        weight = 1.0 + 2.0 * (self.shift_m > 0.5) + 1.0 * (self.shift_m > 2.0)
        weight += 1.0 * (command < 3) + 1.0 * (command > 3) + 1.0 * line.any(1)
        return np.asarray(weight / weight.sum())

    def draw(
        self, rng: np.random.Generator, count: int, how: Sequences
    ) -> npt.NDArray[np.int64]:
        """[count, length] samples that follow each other."""
        stride = rng.choice(how.strides, count)
        last = rng.choice(len(self), count, p=self.weights)
        steps = np.arange(how.length) - (how.length - 1)
        picked = last[:, None] + steps * stride[:, None]
        # never across the beginning of an episode: slide forward instead
        picked += np.maximum(self.first[last] - picked[:, 0], 0)[:, None]
        return np.asarray(np.minimum(picked, self.last[last][:, None]))

    @cached_property
    def first(self) -> npt.NDArray[np.int64]:
        """First sample of the episode of every sample."""
        ends = np.unique(self.last)
        starts = np.concatenate([[0], ends[:-1] + 1])
        return np.asarray(starts[np.searchsorted(ends, self.last)])

    def images(self, picked: npt.NDArray[np.int64]) -> npt.NDArray[np.uint8]:
        """[n] samples to uint8 [n, 6, H, W, 3]."""
        return np.stack([decode(self.pictures[i]) for i in picked])

    def batch(self, picked: npt.NDArray[np.int64]) -> dict[str, Array]:
        """Rows of [B, L] samples as [B, L, ...], the CAN bus completed."""
        batch = {name: table[picked] for name, table in self.tables.items()}
        batch["moves"] = self.moves[picked]
        batch["shift_m"] = self.shift_m[picked]
        batch["can_bus"] = _moved(batch["can_bus"], batch["pose"])
        return batch


def _moved(can_bus: Floats, pose: Floats) -> Floats:
    """Fill in how far the ego came since the sample before: [B, L, 18]."""
    filled = can_bus.copy()
    step = np.diff(pose, axis=1)
    filled[:, 1:, 0:2] = step[..., :2]
    filled[:, :, 16] = pose[..., 2] % (2 * math.pi)
    turned = np.remainder(step[..., 2] + math.pi, 2 * math.pi) - math.pi
    filled[:, 1:, 17] = np.degrees(turned)
    return filled
