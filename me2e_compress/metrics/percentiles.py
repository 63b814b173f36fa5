"""Percentiles of a sample, and how many samples they need."""

import math
from collections.abc import Sequence


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
