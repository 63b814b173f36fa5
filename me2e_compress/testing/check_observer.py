"""Check that an observer makes the ranges that calibration needs."""

import numpy as np
import numpy.typing as npt

from me2e_compress.calibration.observers import OBSERVERS, Bounds, Observer
from me2e_compress.calibration.statistics import BINS, Statistics
from me2e_compress.errors import FramesError
from me2e_compress.testing.form import check_form, require

FRAMES, ELEMENTS = 6, 500


def check_observer(observer: Observer, seed: int = 0) -> tuple[Bounds, Bounds]:
    """Check that an observer makes ranges that int8 can be put on.

    It passes :func:`check_form`; it asks for histograms exactly if it reads them; the
    same statistics give the same ranges; these are two finite float32 arrays [tensors],
    the low bound at most the high one, within what was seen; and the range of a tensor
    does not depend on the other tensors. The statistics are of five random tensors:
    normal, one-sided, heavy-tailed, constant and zero. Returns their low and high
    bounds.

    Raises:
        VerificationError: it broke a promise; the message says which.
    """
    check_form(observer, OBSERVERS)
    name, tensors = observer.name, _tensors(seed)
    _check_counts(observer, tensors)
    # the same statistics give the same ranges
    seen = _statistics(tensors, observer.counts)
    lows, highs = observer.ranges(seen)
    again = observer.ranges(seen)
    require(_equal((lows, highs), again), f"{name} gives two ranges for one tensor")
    _check_bounds(name, seen, lows, highs)
    # the order of the tensors does not matter
    turned = observer.ranges(_statistics(tensors[::-1], observer.counts))
    alike = _equal((lows[::-1], highs[::-1]), turned)
    require(alike, f"{name}: the range of a tensor depends on the other tensors")
    return lows, highs


def _check_counts(observer: Observer, tensors: list[npt.NDArray[np.float32]]) -> None:
    name, reads = observer.name, False
    try:
        observer.ranges(_statistics(tensors, histograms=False))
    except FramesError:
        reads = True
    require(
        observer.counts or not reads, f"{name} reads histograms, and counts is False"
    )
    require(
        reads or not observer.counts,
        f"{name} reads no histograms, and counts is True: a second pass over the frames"
        " for nothing",
    )


def _check_bounds(name: str, seen: Statistics, lows: Bounds, highs: Bounds) -> None:
    count = len(seen.tensors)
    for bounds in (lows, highs):
        require(
            bounds.shape == (count,) and bounds.dtype == np.float32,
            f"{name}: a bound is {bounds.dtype} {list(bounds.shape)}, it must be"
            f" float32 [{count}]",
        )
        require(np.isfinite(bounds).all(), f"{name}: a bound is not finite")
    # low bounds below high ones, and within what was seen
    for tensor, low, high in zip(seen.tensors, lows, highs, strict=True):
        require(
            low <= high,
            f"{name}: tensor {tensor!r}: the low bound {low:g} is above the high one"
            f" {high:g}",
        )
    inside = (lows >= seen.lows.min(axis=0)) & (highs <= seen.highs.max(axis=0))
    require(
        inside.all(),
        f"{name}: a range reaches beyond what was seen, where steps are wasted",
    )


def _equal(one: tuple[Bounds, Bounds], other: tuple[Bounds, Bounds]) -> bool:
    return all(
        np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other, strict=True)
    )


def _tensors(seed: int) -> list[npt.NDArray[np.float32]]:
    """Draw five tensors: float32 [frames, elements]."""
    draws = np.random.default_rng(seed)
    shape = FRAMES, ELEMENTS
    return [
        np.asarray(values, np.float32)
        for values in (
            draws.normal(1.0, 2.0, shape),
            np.maximum(draws.normal(0.0, 1.0, shape), 0),
            draws.standard_cauchy(shape),
            np.full(shape, -0.3),
            np.zeros(shape),
        )
    ]


def _statistics(tensors: list[npt.NDArray[np.float32]], histograms: bool) -> Statistics:
    """Measure the tensors as a calibration does."""
    each = [(x.min(axis=1), x.max(axis=1), np.square(x).mean(axis=1)) for x in tensors]
    measured = np.asarray(each, np.float32).transpose(2, 0, 1)
    names = tuple(f"t{at}" for at in range(len(tensors)))
    places = tuple(range(FRAMES))
    seen = Statistics("model", "source", names, places, measured)
    # histograms, if the observer reads them
    if not histograms:
        return seen
    counts = [
        np.histogram(np.abs(x), BINS, (0.0, 2.0**exponent))[0]
        for x, exponent in zip(tensors, seen.exponents, strict=True)
    ]
    return Statistics("model", "source", names, places, measured, np.array(counts))
