"""The figures of a page, as SVG: a row a variant or a drive, a panel a number."""

import io
import itertools
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context

from me2e_compress.base.display import cell_text
from me2e_compress.metrics.measure import Estimate
from me2e_compress.metrics.scores import Scores
from me2e_compress.study.cells import estimate_cell, measure_cell, number
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.study_result import StudyResult

INK, MUTED, RULE = "#1d2127", "#6b7480", "#d9dde3"
ACCENT, BASELINE = "#2a6fb0", "#1d2127"
STYLE = Path(__file__).with_name("report.mplstyle")
# Text stays text: matplotlib measures one font, the page shows its own
PAGE_FONT = "Inter, 'Segoe UI', 'Helvetica Neue', Arial, sans-serif"
WIDTH_IN = 9.2  # width of the page's column
# Height of a row, of one of many, and of titles and axes
ROW_IN, LOW_ROW_IN, FRAME_IN = 0.42, 0.33, 0.72
MANY_ROWS = 8
# With more drives than this, the first figure has those of one condition alone
MOST_DRIVES = 14
LONGEST_NAME = 20  # characters of a name on one line
# Title, largest value there can be, and score of each panel of the road
SCORES: tuple[tuple[str, float | None, Callable[[Scores], Estimate]], ...] = (
    ("Success rate, %", 100.0, lambda scores: scores.success_rate),
    ("Room kept to others, %", 100.0, lambda scores: scores.safety.room_kept),
    ("Speed, % of the traffic's", None, lambda scores: scores.efficiency),
)


def styled() -> AbstractContextManager[None]:
    """Return a context that ignores the user's matplotlib settings."""
    return context(STYLE, after_reset=True)


def svg(figure: Figure) -> Markup:
    """Write a figure as an SVG element, reproducibly."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    return Markup(text[text.index("<svg") :].replace("'DejaVu Sans'", PAGE_FONT))


@dataclass(frozen=True)
class Mark:
    """A number, the words above it, and a line from its low to its high end."""

    place: float
    colour: str
    words: str
    value: float | None
    low: float | None = None
    high: float | None = None
    filled: bool = True

    @classmethod
    def of(cls, place: float, colour: str, estimate: Estimate, name: str = "") -> Self:
        """Mark a mean with its interval; ``name`` stands before the number."""
        words = f"{name}: " * bool(name) + cell_text(estimate_cell(estimate))
        ends = estimate.low, estimate.high
        return cls(place, colour, words, estimate.value, *ends)


@dataclass(frozen=True)
class Panel:
    """The marks of one number on an axis that begins at zero."""

    title: str
    marks: Sequence[Mark]
    bars: bool = False  # whether values are bars, not dots
    # The largest value there can be; None if there is no such
    most: float | None = None
    signed: bool = False  # whether values are differences around zero


def answer(outcome: StudyResult) -> Markup:
    """Draw size, time, plan and driving score, a row a variant."""
    names = [condition.name for condition in outcome.study.conditions]
    if len(outcome.drives) > MOST_DRIVES:
        names = names[:1]
    # A variant is as high as its drives, and stands in their middle
    places, rows, top = dict[str, float](), list[tuple[float, DriveRecord]](), 0
    for variant in outcome.variants:
        theirs = (drive for drive in outcome.drives if drive.variant == variant.name)
        shown = [drive for drive in theirs if drive.condition in names]
        rows += enumerate(shown, top)
        height = max(1, len(shown))
        places[variant.name] = top + (height - 1) / 2
        top += height
    # A cost names its share of the baseline's
    panels = [
        *_cost_panels(outcome, places),
        _score_panel(outcome, rows, len(names) > 1),
    ]
    return _draw_panels(places, top, panels)


def road(outcome: StudyResult) -> Markup:
    """Draw the scores of every drive."""
    rows = list(enumerate(outcome.drives))
    panels = [_score_panel(outcome, rows)] * (len(outcome.drives) > MOST_DRIVES)
    for title, most, pick in SCORES:
        marks = [
            Mark.of(place, _colour(outcome, drive.variant), pick(drive.scores))
            for place, drive in rows
            if drive.scores
        ]
        panels.append(Panel(title, marks, most=most))
    names = {outcome.label(drive): place for place, drive in rows}
    return _draw_panels(names, len(rows), panels)


def differences(outcome: StudyResult) -> Markup | None:
    """Draw every difference to the baseline with its interval; None without one."""
    rows = [(drive, gap) for drive in outcome.drives if (gap := drive.difference)]
    if not rows:
        return None
    gaps = {
        "Driving score, points": [gap.driving_score for _, gap in rows],
        "Success rate, points": [gap.success_rate for _, gap in rows],
        "Room kept to others, points": [gap.room_kept for _, gap in rows],
    }
    panels = list[Panel]()
    for title, estimates in gaps.items():
        marks = list[Mark]()
        for place, mean in enumerate(estimates):
            words = cell_text(estimate_cell(mean, signed=True))
            colour, ends = ACCENT if mean.sign else MUTED, (mean.low, mean.high)
            filled = bool(mean.sign)
            marks.append(Mark(place, colour, words, mean.value, *ends, filled=filled))
        panels.append(Panel(title, marks, signed=True))
    names = {outcome.label(drive): place for place, (drive, _) in enumerate(rows)}
    return _draw_panels(names, len(rows), panels)


def _colour(outcome: StudyResult, variant: str) -> str:
    return BASELINE if variant == outcome.study.baseline else ACCENT


def _cost_panels(outcome: StudyResult, places: Mapping[str, float]) -> Iterator[Panel]:
    """Yield the panels of size, time and plan; ``places`` are the variants' rows."""
    baseline = outcome.variant(outcome.study.baseline)
    sizes, times, plans = list[Mark](), list[Mark](), list[Mark]()
    for variant in outcome.variants:
        place, colour = places[variant.name], _colour(outcome, variant.name)
        # Size and time, with their shares of the baseline's
        for marks, measure, base, form in (
            (sizes, variant.size_mb, baseline.size_mb, ".2f"),
            (times, variant.latency_ms[50], baseline.latency_ms[50], ".1f"),
        ):
            words = measure_cell(measure, form).text
            if variant is not baseline and measure.value is not None and base.value:
                words += f" ({100.0 * measure.value / base.value:.0f} %)"
            marks.append(Mark(place, colour, words, measure.value))
        # Distances from the baseline's plan, from the mean to the largest
        mean, most = variant.fidelity.plan_mean, variant.fidelity.plan_max.value
        words = measure_cell(mean, ".2f").text
        if variant is baseline:
            words = "the reference"
        elif most is not None:
            words += f" (at most {number(most, '.2f')})"
        plans.append(Mark(place, colour, words, mean.value, mean.value, most))
    yield Panel("File, MB", sizes, bars=True)
    yield Panel("Time of a decision, ms", times, bars=True)
    yield Panel("Plan moves by, m", plans)


def _score_panel(
    outcome: StudyResult, rows: Iterable[tuple[float, DriveRecord]], named: bool = False
) -> Panel:
    """Return the panel of driving scores, with the condition's name if asked for."""
    marks = list[Mark]()
    for place, drive in rows:
        name, colour = drive.condition * named, _colour(outcome, drive.variant)
        if drive.scores is None:
            words = f"{name}: not driven" if name else "not driven"
            marks.append(Mark(place, colour, words, None))
        else:
            marks.append(Mark.of(place, colour, drive.scores.driving_score, name))
    return Panel("Driving score, 0 to 100", marks, most=100.0)


def _draw_panels(
    names: Mapping[str, float], rows: int, panels: Sequence[Panel]
) -> Markup:
    """Draw panels side by side; names stand at their places of so many rows."""
    with styled():
        height = FRAME_IN + rows * (ROW_IN if rows <= MANY_ROWS else LOW_ROW_IN)
        figure = Figure(figsize=(WIDTH_IN, height))
        figure.set_layout_engine("constrained", wspace=0.07)
        axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for column, panel in zip(axes, panels, strict=True):
            _draw_panel(column, panel)
        lines = [textwrap.fill(name, LONGEST_NAME) for name in names]
        axes[0].set_yticks(list(names.values()), lines, color=INK)
        axes[0].set_ylim(rows - 0.4, -0.75)
        # A rule between names
        for column in axes:
            for one, other in itertools.pairwise(names.values()):
                column.axhline((one + other) / 2 - 0.17, color=RULE, linewidth=0.6)
        return svg(figure)


def _draw_panel(axes: Axes, panel: Panel) -> None:
    """Draw the marks of a panel, each below its words."""
    axes.grid(visible=True, axis="x")
    axes.spines["left"].set_visible(False)
    axes.locator_params(axis="x", nbins=4)
    axes.set_title(panel.title, color=INK, fontweight="bold")
    for mark in panel.marks:
        # Words are above, where no other mark is
        axes.annotate(
            mark.words,
            (0.0, mark.place),
            xycoords=axes.get_yaxis_transform(),
            xytext=(0.0, 6.0),
            textcoords="offset points",
            color=INK if mark.value is not None else MUTED,
            fontsize=8.5,
            bbox={"facecolor": "white", "alpha": 0.85, "linewidth": 0, "pad": 0.3},
        )
        if mark.value is None:
            continue
        row, fill = [mark.place] * 2, mark.colour if mark.filled else "white"
        if panel.bars:
            axes.plot(
                [0.0, mark.value], row, color=mark.colour, linewidth=6.0,
                solid_capstyle="butt",
            )  # fmt: skip
            continue
        if mark.low is not None and mark.high is not None:
            ends = [mark.low, mark.high]
            axes.plot(ends, row, color=mark.colour, alpha=0.55, linewidth=2.0)
        axes.plot(
            [mark.value], row[:1], "o", color=mark.colour, markersize=5.5,
            markerfacecolor=fill, clip_on=False,
        )  # fmt: skip
    # An axis shows zero, and what can be reached
    shown = (end for mark in panel.marks for end in (mark.value, mark.low, mark.high))
    known = [end for end in shown if end is not None]
    most = panel.most or 1.06 * max(known, default=0.0) or 1.0
    if panel.signed:
        axes.axvline(0.0, color=INK, linewidth=0.8)
        axes.set_xlim(min(1.06 * min(known, default=0.0), -1.0), max(most, 1.0))
    else:
        axes.set_xlim(-0.015 * most, 1.015 * most)
