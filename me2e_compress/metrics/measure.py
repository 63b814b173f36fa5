"""A value with its unit, or the reason why it was not measured."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

# Percentiles of a sample, and how many samples they need.


def too_few(percent: float, count: int) -> str:
    """Say why there are too few samples for a percentile; empty if there are enough.

    At least one sample must lie beyond it, n (1 - q) >= 1. With fewer, the percentile
    (the inverted distribution function, type 1 of Hyndman and Fan 1996) is just the
    maximum.

    Args:
        percent: Above 0, below 100.
        count: Measured samples; for latencies drawn from a trace, the length of the
            trace.
    """
    # 100 / (100 - 99.9) is a little more than 1000 in floating point
    needed = math.ceil(round(100.0 / (100.0 - percent), 6))
    return "" if count >= needed else f"needs {needed:,} samples, has {count:,}"


def percentile(samples: Sequence[int], percent: float) -> int:
    """Return the smallest sample that so many percent do not exceed."""
    # in whole numbers: 0.999 * 1000 is 999.0000000000001 in floating point
    rank = -(-len(samples) * round(10 * percent) // 1000)
    return sorted(samples)[rank - 1]


@dataclass(frozen=True, slots=True)
class Measure:
    """A value and its unit; None means it could not be measured, never zero.

    Raises:
        ValueError: There is neither a finite value nor a reason, or both.
    """

    value: float | None
    unit: str
    reason: str = ""

    def __post_init__(self) -> None:
        if self.value is not None and not math.isfinite(self.value):
            raise ValueError(f"a measure must be finite, found {self.value}")
        if (self.value is None) != bool(self.reason):
            raise ValueError("a measure has either a value or a reason for having none")

    def to_json(self) -> dict[str, float | str | None]:
        """Return value, unit and reason."""
        reason = self.reason or None
        return {"value": self.value, "unit": self.unit, "reason": reason}


@dataclass(frozen=True, slots=True)
class Estimate:
    """A mean over routes with its 95 % interval.

    ``low`` and ``high`` bound the interval over these scenario types, ``anew_low`` and
    ``anew_high`` the wider one over types drawn anew (`metrics.intervals`); they are
    None if n is too small or they were not computed.
    """

    measure: Measure
    low: float | None
    high: float | None
    n: int
    anew_low: float | None = None
    anew_high: float | None = None

    @classmethod
    def missing(cls, unit: str, reason: str, n: int = 0) -> "Estimate":
        """Return no mean, and the reason why there is none."""
        return cls(Measure(None, unit, reason), None, None, n)

    @property
    def value(self) -> float | None:
        """The mean itself."""
        return self.measure.value

    @property
    def sign(self) -> int:
        """Sign of a difference that is certain as printed, to a tenth; otherwise 0."""
        if self.low is not None and round(self.low, 1) > 0.0:
            return 1
        return -1 if self.high is not None and round(self.high, 1) < 0.0 else 0

    def to_json(self) -> dict[str, float | int | str | None]:
        """Return a flat object of all fields."""
        return {
            "value": self.measure.value,
            "low": self.low,
            "high": self.high,
            "anew_low": self.anew_low,
            "anew_high": self.anew_high,
            "n": self.n,
            "unit": self.measure.unit,
            "reason": self.measure.reason or None,
        }
