"""Episodes in memory, and short sequences drawn from them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from me2e_compress.errors import TrainingError
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

    def __init__(self, files: Sequence[Path]) -> None:
        """Read episodes.

        Raises:
            TrainingError: there is none, or one is not an episode.
        """
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
        self.frenet = project(self.tables["plan"], self.tables["path"])
        shift = np.linalg.norm(self.tables["plan"] - self.tables["plan_alone"], axis=-1)
        self.shift_m = shift.mean(-1)

    def _read(self, file: Path, tables: dict[str, list[Array]]) -> int:
        try:
            with np.load(file) as content:
                if "jpeg" not in content.files:
                    return 0
                for name in KEPT:
                    tables[name].append(content[name])
                offsets, data = content["jpeg_offsets"], content["jpeg"]
        except (OSError, ValueError, KeyError) as error:
            raise TrainingError(f"{file}: not an episode: {error}") from error
        cuts = zip(offsets, offsets[1:], strict=False)
        self.pictures += [data[begin:end].copy() for begin, end in cuts]
        return len(offsets) - 1

    def __len__(self) -> int:
        """Count the samples."""
        return len(self.last)

    def weights(self) -> Floats:
        """How often a sample is drawn: more where the actors or a signal decide."""
        command = self.tables["command"]
        signals = self.tables["signals"]
        line = (signals[..., 0] >= 0) & (np.abs(signals[..., 6]) < 25)
        weight = 1.0 + 2.0 * (self.shift_m > 0.5) + 1.0 * (self.shift_m > 2.0)
        weight += 1.0 * (command < 3) + 1.0 * (command > 3) + 1.0 * line.any(1)
        return weight / weight.sum()

    def draw(
        self, rng: np.random.Generator, count: int, how: Sequences
    ) -> npt.NDArray[np.int64]:
        """[count, length] samples that follow each other."""
        stride = rng.choice(how.strides, count)
        last = rng.choice(len(self), count, p=self.weights_once)
        steps = np.arange(how.length) - (how.length - 1)
        picked = last[:, None] + steps * stride[:, None]
        # never across the beginning of an episode: slide forward instead
        first = self.first[last]
        picked += np.maximum(first - picked[:, 0], 0)[:, None]
        return np.minimum(picked, self.last[last][:, None])

    @property
    def weights_once(self) -> Floats:
        """`weights`, computed once."""
        if not hasattr(self, "_weights"):
            self._weights = self.weights()
        return self._weights

    @property
    def first(self) -> npt.NDArray[np.int64]:
        """First sample of the episode of every sample."""
        if not hasattr(self, "_first"):
            starts = np.concatenate([[0], np.unique(self.last)[:-1] + 1])
            self._first = starts[np.searchsorted(np.unique(self.last), self.last)]
        return self._first

    def images(self, picked: npt.NDArray[np.int64]) -> npt.NDArray[np.uint8]:
        """[n] samples to uint8 [n, 6, H, W, 3]."""
        return np.stack([decode(self.pictures[i]) for i in picked])

    def batch(self, picked: npt.NDArray[np.int64]) -> dict[str, Array]:
        """Rows of [B, L] samples as [B, L, ...], the CAN bus completed."""
        batch = {name: table[picked] for name, table in self.tables.items()}
        batch["frenet"] = self.frenet[picked]
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
