from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.calibration.observers import (
    OBSERVERS,
    Bounds,
    MeanSquaredError,
    Observer,
    Percentile,
    scale_of,
    within,
)
from me2e_compress.calibration.statistics import BINS, Statistics
from me2e_compress.errors import FramesError, RecipeError
from tests.installed import install
from tests.profiles import scaled

Values = npt.NDArray[np.float64]


def seen(*tensors: Values) -> Statistics:
    """Statistics of one frame, computed the plain way."""
    measured = np.array(
        [[(x.min(), x.max(), np.mean(x * x)) for x in tensors]], np.float32
    )
    names = tuple(f"t{at}" for at in range(len(tensors)))
    bare = Statistics("m", "s", names, (0,), measured)
    counts = [
        np.histogram(np.abs(x), BINS, (0, 2.0**e))[0]
        for x, e in zip(tensors, bare.exponents, strict=True)
    ]
    return Statistics("m", "s", names, (0,), measured, np.array(counts))


def extremes(*frames: tuple[float, float]) -> Statistics:
    measured = np.array([[(low, high, 1)] for low, high in frames], np.float32)
    return Statistics("m", "s", ("t",), tuple(range(len(frames))), measured)


def reach(method: object, x: Values) -> float:
    lows, highs = method.ranges(seen(x))  # type: ignore[attr-defined]
    return float(max(-lows[0], highs[0]))


@pytest.mark.parametrize(
    ("low", "high", "scale"),
    [(-1.27, 0.5, 0.01), (0.0, 12.7, 0.1), (-254.0, 254.0, 2.0), (0.0, 0.0, 1.0)],
)
def test_the_scale_covers_the_larger_side(
    low: float, high: float, scale: float
) -> None:
    assert scale_of(low, high) == np.float32(scale)


@pytest.mark.parametrize("end", [np.nan, np.inf])
def test_what_is_no_number_has_no_step(end: float) -> None:
    with pytest.raises(FramesError, match="has no int8 step"):
        scale_of(-end, 1.0)
    with pytest.raises(FramesError, match="has no int8 step"):
        scale_of(-1.0, end)


@settings(max_examples=scaled(25))
@given(st.floats(0.5, 100), st.integers(0, 9))
def test_a_percentile_leaves_out_no_more_than_it_may(percent: float, seed: int) -> None:
    drawn = np.random.default_rng(seed).standard_cauchy(5000)
    x = drawn.astype(np.float32).astype(np.float64)  # as elements are
    found = reach(Percentile(percent), x)
    magnitudes = np.abs(x)
    bin_width = 2.0 ** np.frexp(magnitudes.max())[1] / BINS

    assert np.mean(magnitudes <= found) >= percent / 100
    assert np.mean(magnitudes <= found - bin_width) < percent / 100


def test_the_mse_threshold_is_the_best_of_a_search_over_the_elements() -> None:
    x = np.random.default_rng(3).standard_t(4, size=20_000)

    def noise(threshold: float) -> float:
        step = threshold / 127
        rounded = np.clip(np.rint(x / step), -127, 127) * step
        return float(np.mean((x - rounded) ** 2))

    best = min(noise(t) for t in np.linspace(0.2, 1, 400) * np.abs(x).max())
    found = noise(reach(MeanSquaredError(), x))

    assert found < noise(np.abs(x).max().item()) * 0.95
    assert found == pytest.approx(best, rel=0.03)


@pytest.mark.parametrize("method", [Percentile(), MeanSquaredError()])
def test_no_method_reaches_beyond_what_was_seen(method: object) -> None:
    x = np.random.default_rng(1).uniform(0, 3, 500)
    lows, highs = method.ranges(seen(x, np.zeros(4)))  # type: ignore[attr-defined]

    assert lows[0] == np.float32(x.min())
    assert 0 < highs[0] <= np.float32(x.max())
    assert (lows[1], highs[1]) == (0, 0)


def test_histogram_methods_say_that_they_lack_histograms() -> None:
    with pytest.raises(FramesError, match="no histograms"):
        Percentile().ranges(extremes((0, 1)))


@pytest.mark.parametrize(
    ("text", "canonical"),
    [
        ("max-min", "max-min"),
        ("percentile", "percentile:99.99"),
        ("percentile:99.9", "percentile:99.9"),
        ("mse", "mse"),
    ],
)
def test_methods_are_read_from_text(text: str, canonical: str) -> None:
    method = OBSERVERS.parse(text)
    assert OBSERVERS.text(method, defaults=True) == canonical
    assert OBSERVERS.parse(canonical) == method


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fp8", "no calibration method 'fp8'; there are max-min, percentile, mse"),
        ("mse:3", "mse takes no value, found '3'"),
        ("percentile:x", "percentile: percent: Input should be a valid number"),
        ("percentile:nan", "percentile: percent must be above 0"),
        ("percentile:0", "must be above 0 and at most 100, found 0"),
        ("entropy", "^entropy is gone since 0.3.0: use mse$"),
        ("moving-average:0.1", "^moving-average is gone since 0.3.0: use max-min$"),
    ],
)
def test_what_is_no_method_is_refused(text: str, message: str) -> None:
    with pytest.raises(RecipeError, match=message):
        OBSERVERS.parse(text)


@dataclass(frozen=True)
class RootMeanSquare(Observer):
    """Some root mean squares to each side."""

    name: ClassVar[str] = "rms"
    times: float = 3.0

    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        reach = self.times * np.sqrt(seen.mean_squares.mean(axis=0))
        return -reach, reach


def test_a_number_goes_to_the_observer_that_it_is_written_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = {"rms": f"{__name__}:RootMeanSquare"}
    install(monkeypatch, tmp_path, "an-rms", "me2e_compress.observers", entry)

    assert OBSERVERS.parse("rms:4") == RootMeanSquare(4.0)


def test_a_range_shrinks_to_what_was_seen_where_the_reach_lies_inside() -> None:
    """A tensor that never comes near zero: half of its largest is below its least."""
    measured = np.array([[[3.0, 4.0, 12.0], [-4.0, -3.0, 12.0]]], np.float32)
    seen = Statistics("", "", ("above", "below"), (0,), measured)

    low, high = within(seen, np.array([2.0, 2.0], np.float32))

    assert (low <= high).all()
    assert low.tolist() == [3.0, -3.0]
    assert high.tolist() == [3.0, -3.0]
