"""How far two answers lie apart, by the manager's own rule, written anew."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from tests.fuzz.exact.running import Arrays, Runner, nudged

TOLERANCES = {"float64": 1e-9, "float32": 1e-4, "float16": 1e-2, "bfloat16": 5e-2}
"""What the manager allows, written out so that nobody loosens both at once."""

TRIALS = 3
"""How often inputs are nudged."""


def distance(wanted: npt.NDArray[Any], found: npt.NDArray[Any]) -> float:
    """Return max|a-b|/max|a| of floats; of anything else, 0 if equal."""
    if wanted.shape != found.shape or wanted.dtype != found.dtype:
        return float("inf")
    if wanted.size == 0:
        return 0.0
    if wanted.dtype.kind != "f":
        return 0.0 if np.array_equal(wanted, found) else float("inf")
    a, b = wanted.astype(np.float64), found.astype(np.float64)
    finite = np.isfinite(a)
    if not np.array_equal(finite, np.isfinite(b)):
        return float("inf")
    if not np.array_equal(a[~finite], b[~finite], equal_nan=True):
        return float("inf")
    if not finite.any():
        return 0.0
    gap = float(np.abs(a[finite] - b[finite]).max())
    scale = float(np.abs(a[finite]).max())
    if gap == 0:
        return 0.0
    return gap / scale if scale else float("inf")


def allowed(values: npt.NDArray[Any]) -> float:
    return TOLERANCES.get(values.dtype.name, 0.0)


class Answers:
    """What a graph answers on some inputs, and how rounding alone moves that."""

    def __init__(self, runner: Runner, feeds: Sequence[Arrays]) -> None:
        self.runner, self.feeds = runner, feeds
        self.values = [runner.run(each) for each in feeds]
        self._moved: list[dict[str, float]] | None = None

    def off(self, at: int, found: Mapping[str, npt.NDArray[Any]]) -> dict[str, float]:
        """Return the outputs that differ by more than is allowed, and by how much."""
        gaps = {
            name: distance(value, found[name])
            for name, value in self.values[at].items()
        }
        wanted = self.values[at]
        return {n: gap for n, gap in gaps.items() if gap > allowed(wanted[n])}

    def is_steady(self, at: int, gaps: Mapping[str, float]) -> bool:
        """Say whether some of these moved further than nudged inputs move them."""
        moved = self._spread(at)
        return any(gap > moved[name] for name, gap in gaps.items())

    def _spread(self, at: int) -> dict[str, float]:
        if self._moved is None:
            self._moved = [self._nudges(each) for each in range(len(self.feeds))]
        return self._moved[at]

    def _nudges(self, at: int) -> dict[str, float]:
        worst = dict.fromkeys(self.values[at], 0.0)
        for trial in range(TRIALS):
            found = self.runner.run(nudged(self.feeds[at], trial))
            for name, value in self.values[at].items():
                worst[name] = max(worst[name], distance(value, found[name]))
        return worst
