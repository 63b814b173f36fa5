"""The paper's figures 5 and 7, from what was driven and timed."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from benchmarks.paper.cells import held_at
from benchmarks.paper.drives import PaperDrives
from benchmarks.paper.periods import frames_per_decision
from benchmarks.paper.published import RATES
from me2e_compress.metrics.route_summary import DC, DE, DS, RouteColumn
from me2e_compress.study.report.figures import (
    ACCENT,
    BASELINE,
    INK,
    MUTED,
    RULE,
    WIDTH_IN,
    styled,
)

RATE_TICKS = (1, 2, 3, 5, 10, 20, 30)
COLOURS = (
    *("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9"),
    *("#d55e00", "#f0e442", "#8c8c8c", "#44337a", "#b7d3a8"),
)
"""Of Okabe and Ito (2008), whom readers with any colour vision can tell apart, and
three in reserve."""
SLOWEST_SHOWN = 6
"""Variants whose tails are drawn; more lines cannot be told apart."""


def safety(result: PaperDrives) -> Figure | None:
    """Draw figure 5a: driving score over the decision rate; None without drives."""
    return _over_rates(result, (DS,))


def efficiency_and_comfort(result: PaperDrives) -> Figure | None:
    """Draw figure 5b: efficiency and comfort over the rate; None without drives."""
    return _over_rates(result, (DE, DC))


def where_the_time_goes(result: PaperDrives) -> Figure | None:
    """Draw figure 7: stacked module times, and tails; None without both."""
    # both panels need measurements
    baseline = result.fact(result.study.baseline)
    timed = [each for each in result.facts if each.latency_us]
    if not timed or not baseline.modules_us:
        return None
    with styled():
        figure = Figure(figsize=(WIDTH_IN, 3.4), layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=(1.7, 1))
        # modules of the baseline on the left
        _stack(left, baseline.modules_us, baseline.variant)
        # tails of several variants on the right
        names = _shown_tails(result)
        for name, colour in zip(names, (BASELINE, *COLOURS), strict=False):
            _tail(right, result.fact(name).latency_us, name, colour)
        right.set_yscale("log")
        right.yaxis.set_major_formatter(PercentFormatter(1.0))
        right.set_xlabel("milliseconds on the device")
        right.set_title("how many decisions take longer", color=MUTED)
        right.legend(frameon=False, fontsize=7.5, loc="upper right")
        return figure


def _over_rates(result: PaperDrives, columns: Sequence[RouteColumn]) -> Figure | None:
    block = next((b for b in result.study.blocks if b.name == "table-2"), None)
    if block is None:
        return None
    name = block.variants[0]
    driven = _driven_rates(result, name, block.conditions)
    if len(driven) < 2:
        return None
    with styled():
        figure = Figure(figsize=(WIDTH_IN, 2.7 * len(columns)), layout="constrained")
        panels = figure.subplots(len(columns), 2, squeeze=False)
        for (ours, theirs), column in zip(panels, columns, strict=True):
            _draw_rates(ours, result, name, driven, column)
            _draw_given(theirs, column)
        return figure


def _driven_rates(
    result: PaperDrives, name: str, conditions: Sequence[str]
) -> list[tuple[float, str]]:
    """Return the paper's rates that were driven, each with its condition."""
    held = {
        frames_per_decision(result.study, each): each.name
        for each in reversed(result.study.conditions)
        if each.name in conditions and not (each.traced or each.mean_of)
    }
    found = list[tuple[float, str]]()
    for row in RATES:
        condition = held.get(held_at(row.fps))
        if condition is not None and not result.drive(name, condition).reason:
            found.append((row.fps, condition))
    return found


def _draw_rates(
    axes: Axes,
    result: PaperDrives,
    name: str,
    driven: Sequence[tuple[float, str]],
    column: RouteColumn,
) -> None:
    """Draw one column over the rates, and the driver at its own latency."""
    # mean and interval at each rate
    seed = result.study.seed
    found = [
        (fps, result.drive(name, where).values(column).mean(seed))
        for fps, where in driven
    ]
    known = [(fps, each) for fps, each in found if each.value is not None]
    sure = [
        (fps, each.low, each.high)
        for fps, each in known
        if each.low is not None and each.high is not None
    ]
    if sure:
        band = np.array(sure, np.float64).T
        axes.fill_between(*band, color=ACCENT, alpha=0.15, linewidth=0)
    values = np.array([(fps, each.value) for fps, each in known], np.float64)
    axes.plot(*values.T, "o-", color=ACCENT, markersize=4)
    # rates that share the last condition are shaded
    free = [fps for fps, where in driven if where == driven[-1][1]]
    if len(free) > 1:
        axes.axvspan(min(free), max(free), color=RULE, alpha=0.45, linewidth=0)
        axes.annotate(
            "one condition",
            (float(np.sqrt(min(free) * max(free))), 0.03),
            xycoords=("data", "axes fraction"),
            ha="center",
            color=MUTED,
            fontsize=7.5,
        )
    _draw_own(axes, result, name, column)
    _rate_axis(axes)
    axes.set_title(f"{column.name}: {name}, 95 % interval", color=MUTED)


def _draw_own(axes: Axes, result: PaperDrives, name: str, column: RouteColumn) -> None:
    # the first condition that charges each model's own latency
    fps = result.fact(name).fps
    traced = [each.name for each in result.study.conditions if each.traced]
    if fps is None or not traced:
        return
    own = result.drive(name, traced[0]).values(column).mean(result.study.seed)
    if own.value is None:
        return
    # a diamond with its interval
    if own.low is not None and own.high is not None:
        axes.plot([fps] * 2, [own.low, own.high], color=INK, linewidth=1.4)
    axes.plot(fps, own.value, "D", color=INK, markersize=5)
    axes.annotate(
        "own latency",
        (fps, own.value),
        xytext=(6, -9),
        textcoords="offset points",
        fontsize=8,
    )


def _draw_given(axes: Axes, column: RouteColumn) -> None:
    """Draw the paper's own figures, on axes of their own."""
    name = {"DS": "ds", "DE %": "de", "DC": "dc"}[column.name]
    at, values = [row.fps for row in RATES], [getattr(row, name) for row in RATES]
    axes.plot(at, values, "o-", color=MUTED, markersize=4, linewidth=1.0)
    _rate_axis(axes)
    axes.set_title(f"{column.name}: the paper's UniAD, as published", color=MUTED)


def _rate_axis(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_xticks(RATE_TICKS, [str(each) for each in RATE_TICKS])
    axes.minorticks_off()
    axes.set_xlabel("decisions a second (FPS)")
    axes.grid(visible=True, axis="y")
    axes.spines["left"].set_visible(False)


def _stack(axes: Axes, parts: Mapping[str, tuple[int, ...]], name: str) -> None:
    """Draw one bar per inference, one colour per module, the largest at the bottom."""
    # largest module first, at the bottom
    ordered = sorted(parts.items(), key=lambda part: -sum(part[1]))
    total = sum(sum(samples) for _, samples in ordered)
    count = len(ordered[0][1])
    # one bar per inference
    at, floor = np.arange(1, count + 1), np.zeros(count)
    for (module, samples), colour in zip(ordered, COLOURS, strict=False):
        height = np.array(samples) / 1e3
        label = f"{module}  {sum(samples) / max(1, total):.0%}"
        axes.bar(at, height, 1.0, floor, color=colour, label=label, linewidth=0)
        floor += height
    # legend in the order of the stack
    axes.set_xlim(0.5, count + 0.5)
    axes.set_xlabel(f"inference of {name}, under a profiler")
    axes.set_title("milliseconds by module, on the device", color=MUTED)
    axes.legend(
        loc="upper left",
        bbox_to_anchor=(1.0, 1.0),
        frameon=False,
        reverse=True,
        fontsize=7.5,
    )


def _shown_tails(result: PaperDrives) -> list[str]:
    """Return the baseline, and the other variants with the longest tails."""
    baseline = result.study.baseline
    others = [each for each in result.facts if each.latency_us]
    ranked = sorted(others, key=lambda each: -(each.latency_ms(99) or 0.0))
    names = [each.variant for each in ranked if each.variant != baseline]
    return [baseline, *names[: SLOWEST_SHOWN - 1]]


def _tail(axes: Axes, samples_us: Sequence[int], name: str, colour: Any) -> None:
    """Draw the share of inferences that exceed each latency."""
    if not samples_us:
        return
    count = len(samples_us)
    slower = 1 - np.arange(count) / count
    axes.step(
        np.sort(samples_us) / 1e3,
        slower,
        where="pre",
        color=colour,
        label=name,
        linewidth=1.2,
    )
