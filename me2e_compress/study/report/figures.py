"""The figures of a report, as SVG."""

import io
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context

from me2e_compress.metrics.measure import Estimate
from me2e_compress.metrics.scores import Scores
from me2e_compress.study.condition import Condition
from me2e_compress.study.study_result import StudyResult

INK, MUTED, RULE = "#1d2127", "#6b7480", "#d9dde3"
ACCENT, BASELINE = "#2a6fb0", "#1d2127"
STYLE = Path(__file__).with_name("report.mplstyle")
PAGE_FONT = "Inter, 'Segoe UI', 'Helvetica Neue', Arial, sans-serif"
"""Text stays text: matplotlib measures one font, the page shows its own."""


def styled() -> AbstractContextManager[None]:
    """Return a context that ignores the user's matplotlib settings."""
    return context(STYLE, after_reset=True)


def svg(figure: Figure) -> Markup:
    """Write a figure as an SVG element, reproducibly."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    return Markup(text[text.index("<svg") :].replace("'DejaVu Sans'", PAGE_FONT))


def bare(axes: Axes) -> None:
    """Leave only a light grid along x."""
    axes.grid(visible=True, axis="x")
    axes.spines["left"].set_visible(False)


CROWD = 6
"""With more variants than this, only the front and the baseline bear names and bars."""
WIDTH_IN = 9.2
"""Width of the page's column."""
LINE_PT = 10.5
"""Height of a line of labels, points."""
CHARACTER_PT = 4.9
"""Mean width of a character, points: an estimate is enough here."""
GAP_PT = 7.0
POINTS_AN_INCH = 72.0


@dataclass(frozen=True)
class Point:
    """A variant in the plane of cost (megabytes or milliseconds) and driving score."""

    name: str
    cost: float
    score: Estimate
    baseline: bool

    @property
    def height(self) -> float:
        """The driving score itself."""
        return self.score.value or 0.0


def front(points: Sequence[Point]) -> list[Point]:
    """Return the points that no other beats in both respects, cheapest first."""
    best, kept = float("-inf"), list[Point]()
    for point in sorted(points, key=lambda p: (p.cost, -p.height)):
        if point.height > best:
            kept.append(point)
            best = point.height
    return kept


def pareto(outcome: StudyResult, condition: Condition) -> Markup | None:
    """Draw driving score against latency and against size; None below two points."""
    # panels with at least two points
    baseline, panels = outcome.study.baseline, list[tuple[list[Point], str]]()
    costs = {
        "median latency, ms": {e.name: e.latency_ms[50] for e in outcome.variants},
        "size, MB": {each.name: each.size_mb for each in outcome.variants},
    }
    for words, by_name in costs.items():
        points = [
            Point(name, cost, drive.scores.driving_score, name == baseline)
            for drive in outcome.under(condition)
            if drive.scores is not None
            if (cost := by_name[name := drive.variant].value) is not None
        ]
        if len(points) > 1:
            panels.append((points, words))
    if not panels:
        return None
    with styled():
        figure = Figure(figsize=(WIDTH_IN, 3.4), layout="constrained")
        axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for each, (points, words) in zip(axes, panels, strict=True):
            _scatter(each, points, words)
        axes[0].set_ylabel("driving score")
        # names are placed last, when the limits are final
        figure.canvas.draw_idle()
        for each, (points, _) in zip(axes, panels, strict=True):
            _place_names(figure, each, _named(points))
        return svg(figure)


def forest(outcome: StudyResult) -> Markup | None:
    """Draw every difference to the baseline with its interval; None without one."""
    # drives that have a difference to the baseline
    rows = [each for each in outcome.drives if each.difference is not None]
    if not rows:
        return None
    names = [outcome.label(each) for each in rows]
    with styled():
        height = 0.9 + 0.26 * len(rows)
        figure = Figure(figsize=(WIDTH_IN, height), layout="constrained")
        panels = figure.subplots(1, 3, sharey=True)
        # one panel per score, sharing the rows
        gaps = [each.difference for each in rows if each.difference]
        scores = {
            "driving score, points": [each.driving_score for each in gaps],
            "room kept, points": [each.room_kept for each in gaps],
            "success rate, points": [each.success_rate for each in gaps],
        }
        for axes, (title, found) in zip(panels, scores.items(), strict=True):
            bare(axes)
            axes.axvline(0.0, color=INK, linewidth=0.8)
            for row, estimate in enumerate(found):
                low, high = estimate.low, estimate.high
                colour = ACCENT if estimate.sign else MUTED
                if low is not None and high is not None:
                    axes.plot([low, high], [row, row], color=colour, linewidth=1.6)
                if estimate.value is not None:
                    axes.plot(estimate.value, row, "o", color=colour, markersize=5)
            axes.margins(y=0.08 if len(found) > 3 else 0.3)
            left, right = axes.get_xlim()
            axes.set_xlim(min(left, -1.0), max(right, 1.0))
            axes.set_title(title, color=MUTED)
        panels[0].set_yticks(range(len(rows)), names, color=INK)
        panels[0].invert_yaxis()
        return svg(figure)


def _named(points: Sequence[Point]) -> Sequence[Point]:
    if len(points) <= CROWD:
        return points
    best = front(points)
    return [point for point in points if point.baseline or point in best]


def _scatter(axes: Axes, points: Sequence[Point], words: str) -> None:
    bare(axes)
    axes.grid(visible=True, axis="y")
    # the Pareto front as a step
    best = front(points)
    axes.step(
        [p.cost for p in best],
        [p.height for p in best],
        where="post",
        color=ACCENT,
        alpha=0.35,
        linewidth=1.2,
        zorder=1,
    )
    # intervals only for points that are named
    named = _named(points)
    for point in points:
        colour = BASELINE if point.baseline else ACCENT
        low, high = point.score.low, point.score.high
        if point in named and low is not None and high is not None:
            axes.plot(
                [point.cost] * 2,
                [low, high],
                color=colour,
                alpha=0.3,
                linewidth=1.2,
                zorder=2,
            )
        shade = 1.0 if point in named else 0.35
        axes.plot(
            *(point.cost, point.height, "o"),
            color=colour,
            alpha=shade,
            markersize=5,
            zorder=3,
        )
    # the cost axis starts at zero, with room for names
    axes.set_xlabel(words)
    axes.margins(x=0.12)
    axes.set_xlim(left=0.0)


def _place_names(figure: Figure, axes: Axes, points: Sequence[Point]) -> None:
    """Write names right of their points, shifted where they would overlap."""
    # positions in points, independent of the axes
    scale = POINTS_AN_INCH / figure.dpi
    ends = list[tuple[float, float, float]]()
    spots = [
        (each, axes.transData.transform((each.cost, each.height)) * scale)
        for each in points
    ]
    for point, (left, up) in sorted(spots, key=lambda spot: -spot[1][1]):
        # from the top down, move below the names already placed
        start = left + GAP_PT
        end = start + CHARACTER_PT * len(point.name)
        height = up
        for other_start, other_end, other_height in ends:
            meets = start < other_end and other_start < end
            if meets and other_height - height < LINE_PT:
                height = other_height - LINE_PT
        ends.append((start, end, height))
        # a line connects a moved name with its point
        moved = abs(height - up) > 1.0
        axes.annotate(
            point.name,
            (point.cost, point.height),
            xytext=(GAP_PT, height - up),
            textcoords="offset points",
            va="center",
            fontsize=8.5,
            color=INK,
            arrowprops={"arrowstyle": "-", "color": RULE} if moved else None,
            annotation_clip=False,
            bbox={"facecolor": "white", "alpha": 0.8, "linewidth": 0, "pad": 0.5},
        )


ENOUGH = 3
"""Fewest conditions that make a curve; fewer are read off the tables."""

Score = Callable[[Scores], Estimate]


def curves(outcome: StudyResult) -> Markup | None:
    """Draw driving score, room and success as SVG; None below three conditions."""
    if len(outcome.study.conditions) < ENOUGH:
        return None
    # panels over the same conditions
    panels: tuple[tuple[str, Score], ...] = (
        ("driving score", lambda scores: scores.driving_score),
        ("room kept, %", lambda scores: scores.safety.room_kept),
        ("success rate, %", lambda scores: scores.success_rate),
    )
    names = [condition.name for condition in outcome.study.conditions]
    with styled():
        figure = Figure(figsize=(WIDTH_IN, 3.0), layout="constrained")
        # one curve per variant
        for axes, (title, pick) in zip(figure.subplots(1, 3), panels, strict=True):
            for variant in outcome.variants:
                _curve(axes, variant.name, pick, outcome)
            axes.set_title(title, color=MUTED)
            axes.set_xticks(range(len(names)), names)
            axes.set_ylim(0.0, 102.0)
            axes.grid(visible=True, axis="y")
            axes.spines["left"].set_visible(False)
        return svg(figure)


def _curve(axes: Axes, name: str, pick: Score, outcome: StudyResult) -> None:
    # conditions under which the variant was driven
    colour = BASELINE if name == outcome.study.baseline else ACCENT
    drives = [each for each in outcome.drives if each.variant == name]
    driven = [
        (place, each.value, each.low, each.high)
        for place, drive in enumerate(drives)
        if drive.scores is not None and (each := pick(drive.scores)).value is not None
    ]
    # intervals are drawn under the curve
    for place, _, low, high in driven:
        if low is not None and high is not None:
            axes.plot([place] * 2, [low, high], color=colour, alpha=0.3, linewidth=1.6)
    axes.plot(
        [place for place, *_ in driven],
        [value for _, value, *_ in driven],
        "o-",
        color=colour,
        linewidth=1.2,
        markersize=5,
    )
    # the name at the end of the curve
    if driven and len(outcome.variants) > 1:
        place, value, *_ = driven[-1]
        axes.annotate(
            name, (place, value), xytext=(7, 0), textcoords="offset points", va="center"
        )
