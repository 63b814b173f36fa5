"""The picture of profile: nothing overprinted, nothing that was not measured."""

from itertools import pairwise

import numpy as np
import pytest

from me2e_compress.runtime.latency_trace import LatencyTrace

pytest.importorskip("matplotlib")

from me2e_compress.workflows.latency_figure import modules_figure


def trace_of(count: int) -> LatencyTrace:
    taken = np.random.default_rng(0).integers(22_000, 22_100, count).tolist()
    return LatencyTrace("0", "a CPU", (16_000,) * count, modules_us={"a": tuple(taken)})


def marks(count: int) -> list[str]:
    legend = modules_figure(trace_of(count), "m").axes[1].get_legend()
    return [] if legend is None else [each.get_text() for each in legend.get_texts()]


def test_few_samples_have_no_p99_in_the_tail() -> None:
    assert [text.split()[0] for text in marks(200)] == ["p50", "p99"]
    assert [text.split()[0] for text in marks(16)] == ["p50"]
    assert marks(1) == []


def test_percentiles_that_are_close_do_not_overprint() -> None:
    figure = modules_figure(trace_of(200), "m")
    figure.draw_without_rendering()
    tail = figure.axes[1]
    legend = tail.get_legend()
    assert legend is not None
    heights = [each.get_window_extent() for each in (tail.patch, legend)]
    widths = [each.get_window_extent() for each in legend.get_texts()]

    assert heights[0].y1 <= heights[1].y0 + 1
    assert all(left.x1 < right.x0 for left, right in pairwise(widths))


def test_it_says_that_the_profiler_takes_time() -> None:
    figure = modules_figure(trace_of(16), "m")

    assert "profiler, which takes time itself: 22 ms" in figure.get_suptitle()
    assert "16 ms without" in figure.get_suptitle()
