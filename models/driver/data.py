"""Episodes in memory, and short sequences drawn from them."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from models.driver.episodes import decode
from models.driver.errors import TrainingError
from models.driver.frenet import project
from models.driver.network.config import STEP_S
from models.driver.stored_episode import KEPT, Array, Bytes, read

Floats = npt.NDArray[np.floating]
Flags = npt.NDArray[np.bool_]
Indices = npt.NDArray[np.int64]

JUNCTION = (0, 1, 2)
"""Commands given in a junction: left, right, straight."""
SLOW_MPS = 2.0
"""Below this speed the ego can stop within a metre at `BRAKE_MPS2`."""
CREEPING_MPS = 1.5
"""Final speed of a plan that keeps rolling and does not set off."""
HELD_M = 2.0
"""A plan that would be this much longer without other road users waits for one."""
BRAKE_MPS2 = 2.0
"""A comfortable stop."""


def is_creeping(moves: Floats, tables: dict[str, Array], alone: Floats) -> Flags:
    """Return which plans roll on slowly towards road users who have priority.

    The expert reconsiders such a plan at every frame and knows every speed exactly; an
    imitator rolls a little faster, and into the conflict.

    Args:
        moves: [N, 6, 2] metres along the route and aside.
        tables: ``can_bus`` and ``command`` of N samples.
        alone: [N, 6, 2] the plans without other road users, in the ego frame.
    """
    arc = moves[..., 0]
    slow = tables["can_bus"][:, 7] < SLOW_MPS
    rolls = (arc[:, -1] - arc[:, -2]) / STEP_S < CREEPING_MPS
    held = np.hypot(alone[:, -1, 0], alone[:, -1, 1]) > arc[:, -1] + HELD_M
    return np.asarray(slow & rolls & held & np.isin(tables["command"], JUNCTION))


def shortened_to_stop(plans: Floats, speed_mps: Floats) -> Floats:
    """Return the plans, shortened to a comfortable stop.

    Args:
        plans: [N, 6, 2] of any frame that begins where the ego is.
        speed_mps: [N] now.
    """
    times = STEP_S * np.arange(1, plans.shape[1] + 1)
    speed = np.maximum(speed_mps, 0.0)[:, None]
    braking = np.minimum(times, speed / BRAKE_MPS2)
    travel = speed * braking - BRAKE_MPS2 / 2 * braking**2
    length = np.linalg.norm(np.diff(plans, axis=1, prepend=0.0), axis=-1).cumsum(1)
    share = np.minimum(travel / np.maximum(length, 1e-6), 1.0)
    return np.asarray(plans * share[..., None])


DECISIVE_M = 0.5
"""Actors that change a plan by more than this, on average over its waypoints, decide
it: half a second at walking speed, or half a car's width aside."""
VERY_DECISIVE_M = 2.0
"""Half a car's length: braking for an actor, or going around it."""
LINE_NEAR_M = 25.0
"""A stop line this near decides: braking at 2 m/s^2 from 10 m/s takes 25 m."""
CHANGE_M = 1.0
"""A plan that is this far from going on as now, on average, is a change of mind."""
ASIDE_M = 0.5
"""A plan that goes this far to the side, at its end, returns or goes around."""
FOLLOW = 3
"""The command to follow the lane; turns come before it, lane changes behind it."""


@dataclass(frozen=True)
class Sequences:
    """How sequences are drawn.

    Attributes:
        length: samples of a sequence; the memory of the model begins empty.
        strides: distances between them, in stored samples.
    """

    length: int = 4
    strides: tuple[int, ...] = (1, 2, 3)


class Episodes:
    """All samples of some episodes, pictures still compressed."""

    def __init__(self, files: Sequence[Path], image_size: tuple[int, int]) -> None:
        """Read episodes.

        Args:
            files: one an episode; what is named twice is drawn twice as often.
            image_size: rows and columns of a camera that the model sees.

        Raises:
            TrainingError: there are none, one is not an episode, or its cameras are
                laid out otherwise.
        """
        if not files:
            raise TrainingError("there are no episodes to learn from")
        times = Counter(files)
        episodes = [read(file, image_size) for file in times]
        self.pictures = [one for each in episodes for one in each.pictures]
        self.tables: dict[str, Array] = {
            name: np.concatenate([each.arrays[name] for each in episodes])
            for name in KEPT
        }
        lengths = [len(each.pictures) for each in episodes]
        self.times = np.repeat(list(times.values()), lengths)
        ends = np.cumsum(lengths)
        self.first = np.repeat(ends - lengths, lengths)
        self.last = np.repeat(ends - 1, lengths)
        self.moves = project(self.tables["plan"], self.tables["path"])
        self.moves[..., 1] -= self.tables["lateral_m"][:, None]
        self._stop_for_others()
        shift = np.linalg.norm(self.tables["plan"] - self.tables["plan_alone"], axis=-1)
        self.shift_m: Floats = shift.mean(-1)

    def _stop_for_others(self) -> None:
        """Turn plans that creep in a junction into stops."""
        rows = is_creeping(self.moves, self.tables, self.tables["plan_alone"])
        speed = self.tables["can_bus"][rows, 7]
        self.moves[rows] = shortened_to_stop(self.moves[rows], speed)
        self.tables["plan"][rows] = shortened_to_stop(self.tables["plan"][rows], speed)

    def __len__(self) -> int:
        """Count the samples."""
        return len(self.last)

    def forget_pictures(self) -> None:
        """Free the pictures: from now on only the rows are needed."""
        self.pictures.clear()

    def departures(self) -> Floats:
        """Return [N, 6, 2], the expert's plans minus coasting at the present speed."""
        times = STEP_S * np.arange(1, self.moves.shape[1] + 1)
        speed = self.tables["can_bus"][:, 7, None]
        coasting = np.stack([speed * times, np.zeros_like(speed * times)], -1)
        return np.asarray(self.moves - coasting)

    @cached_property
    def weights(self) -> Floats:
        """Probability of each sample: more where something decides or changes."""
        command, signals = self.tables["command"], self.tables["signals"]
        line = (signals[..., 0] >= 0) & (np.abs(signals[..., 6]) < LINE_NEAR_M)
        weight = 1.0 + 2.0 * (self.shift_m > DECISIVE_M)
        weight += 1.0 * (self.shift_m > VERY_DECISIVE_M)
        weight += 1.0 * (command != FOLLOW) + 1.0 * line.any(1)
        departures = np.abs(self.departures())
        weight += 1.0 * (departures[..., 0].mean(1) > CHANGE_M)
        weight += 1.0 * (departures[:, -1, 1] > ASIDE_M)
        weight *= self.times
        return np.asarray(weight / weight.sum())

    def draw(self, rng: np.random.Generator, count: int, how: Sequences) -> Indices:
        """Draw [count, length] samples, each row in order from one episode."""
        stride = rng.choice(how.strides, count)
        last = rng.choice(len(self), count, p=self.weights)
        steps = np.arange(how.length) - (how.length - 1)
        picked = last[:, None] + steps * stride[:, None]
        # never across the beginning of an episode: slide forward instead
        picked += np.maximum(self.first[last] - picked[:, 0], 0)[:, None]
        return np.asarray(np.minimum(picked, self.last[last][:, None]))

    def images(self, picked: Indices) -> Bytes:
        """Decode the images of [n] samples: uint8 [n, 6, H, W, 3]."""
        return np.stack([decode(self.pictures[i]) for i in picked])

    def rows(self, picked: npt.NDArray[np.int64]) -> dict[str, Array]:
        """Return the rows of [B] samples as [B, ...]."""
        rows = {name: table[picked] for name, table in self.tables.items()}
        return {**rows, "moves": self.moves[picked], "shift_m": self.shift_m[picked]}

    def batch(self, picked: Indices) -> dict[str, Array]:
        """Return the rows of [B, L] samples as [B, L, ...].

        Besides `KEPT`: ``moves``, the expert's plan as metres along the route and to
        the left of where the ego is beside it; ``shift_m``, how much the actors change
        it. The CAN bus tells the way from the sample before in the sequence.
        """
        batch = self.rows(picked)
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
