"""Percentiles of a sample, and of how many samples one can be told."""

import math
from collections.abc import Sequence


def too_few(percent: float, count: int) -> str:
    """Say why so many samples do not tell a percentile; empty where they do.

    At least one of them must lie beyond it, n (1 - q) >= 1. Of fewer, the smallest
    sample that the share q does not exceed (the inverted distribution function, type 1
    of Hyndman and Fan 1996) is the largest of all, which is called so: the maximum.

    Args:
        percent: above 0, below 100.
        count: samples that were measured; of latencies drawn from a trace, those of the
            trace, however often it was drawn from.
    """
    # 100 / (100 - 99.9) is a little more than 1000 in floating point
    needed = math.ceil(round(100.0 / (100.0 - percent), 6))
    return "" if count >= needed else f"needs {needed:,} samples, has {count:,}"


def percentile(samples: Sequence[int], percent: float) -> int:
    """Return the smallest sample that so many percent do not exceed."""
    # in whole numbers: 0.999 * 1000 is 999.0000000000001 in floating point
    rank = -(-len(samples) * round(10 * percent) // 1000)
    return sorted(samples)[rank - 1]
