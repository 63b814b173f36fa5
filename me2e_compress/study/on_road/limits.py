"""Costs of a scheme, and budgets for them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from me2e_compress.display import significant
from me2e_compress.sensitivity.search import nothing_fits
from me2e_compress.workflows.budgets import Joules, check_budgets


@dataclass(frozen=True)
class Weighed:
    """Costs of one scheme: MB of weights, median decision in ms, joules per frame."""

    mb: float
    ms: float
    joules: float


@dataclass(frozen=True)
class Limits:
    """Budgets, all of which must be met.

    Args:
        max_mb: MB of weights.
        max_ms: Milliseconds, the median of a decision on the device.
        max_joules: Joules per frame.

    Raises:
        RecipeError: There is none, or one is not a finite number above 0.
    """

    max_mb: float | None = None
    max_ms: float | None = None
    max_joules: float | None = None

    def __post_init__(self) -> None:
        check_budgets(self.max_mb, self.max_ms, self.max_joules)

    def spent(self, weighed: Weighed) -> float:
        """Return the largest used share of a budget; 1 is all of it."""
        return max(cost / limit for cost, limit in self._pairs(weighed))

    def words(self, weighed: Weighed, kind: Joules) -> str:
        """Say how much of each budget is used."""
        pairs = zip(self._pairs(weighed), self.units(kind), strict=True)
        return ", ".join(
            f"{significant(cost)} of {significant(most)} {unit}"
            for (cost, most), unit in pairs
        )

    def refusal(self, whole: Weighed, found: Sequence[Weighed], kind: Joules) -> str:
        """Say that nothing fits, and what the least cost was."""
        costs = [[cost for cost, _ in self._pairs(each)] for each in (whole, *found)]
        limits = [limit for _, limit in self._pairs(whole)]
        pairs = tuple(zip(limits, self.units(kind), strict=True))
        return nothing_fits(pairs, costs[0], costs[1:] or costs)

    def units(self, kind: Joules) -> tuple[str, ...]:
        """Return the unit of each budget."""
        asked = ((self.max_mb, "MB"), (self.max_ms, "ms"), (self.max_joules, kind))
        return tuple(unit for limit, unit in asked if limit is not None)

    def _pairs(self, weighed: Weighed) -> Iterator[tuple[float, float]]:
        for cost, limit in (
            (weighed.mb, self.max_mb),
            (weighed.ms, self.max_ms),
            (weighed.joules, self.max_joules),
        ):
            if limit is not None:
                yield cost, limit
