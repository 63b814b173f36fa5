"""The figures of a report, as SVG."""

from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from me2e_compress.metrics.measure import Estimate
from me2e_compress.study.condition import Condition
from me2e_compress.study.outcome import StudyOutcome
from me2e_compress.study.report.style import (
    ACCENT,
    BASELINE,
    INK,
    MUTED,
    RULE,
    bare,
    styled,
    svg,
)

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


def pareto(outcome: StudyOutcome, condition: Condition) -> Markup | None:
    """Draw driving score against latency and against size; None below two points."""
    # panels with at least two points
    latency = _points(outcome, condition, "latency")
    size = _points(outcome, condition, "size")
    panels = [
        (points, words)
        for points, words in (
            (latency, "median latency, ms"),
            (size, "size, MB"),
        )
        if len(points) > 1
    ]
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
            named = [(p.name, p.cost, p.height) for p in _named(points)]
            _place_names(figure, each, named)
        return svg(figure)


def forest(outcome: StudyOutcome) -> Markup | None:
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
            _whiskers(axes, found)
            axes.set_title(title, color=MUTED)
        panels[0].set_yticks(range(len(rows)), names, color=INK)
        panels[0].invert_yaxis()
        return svg(figure)


def _points(outcome: StudyOutcome, condition: Condition, kind: str) -> list[Point]:
    found = list[Point]()
    for drive in outcome.under(condition):
        variant = outcome.variant(drive.variant)
        measure = variant.size_mb if kind == "size" else variant.latency_ms[50]
        if drive.scores is not None and measure.value is not None:
            baseline = drive.variant == outcome.study.baseline
            score = drive.scores.driving_score
            found.append(Point(drive.variant, measure.value, score, baseline))
    return found


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


def _whiskers(axes: Axes, found: Sequence[Estimate]) -> None:
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


def _place_names(
    figure: Figure, axes: Axes, names: Sequence[tuple[str, float, float]]
) -> None:
    """Write names right of their points, shifted where they would overlap."""
    # positions in points, independent of the axes
    scale = POINTS_AN_INCH / figure.dpi
    ends = list[tuple[float, float, float]]()
    spots = [
        (name, x, y, axes.transData.transform((x, y)) * scale) for name, x, y in names
    ]
    for name, x, y, (left, up) in sorted(spots, key=lambda spot: -spot[3][1]):
        # from the top down, move below the names already placed
        start = left + GAP_PT
        end = start + CHARACTER_PT * len(name)
        height = up
        for other_start, other_end, other_height in ends:
            meets = start < other_end and other_start < end
            if meets and other_height - height < LINE_PT:
                height = other_height - LINE_PT
        ends.append((start, end, height))
        # a line connects a moved name with its point
        moved = abs(height - up) > 1.0
        axes.annotate(
            name,
            (x, y),
            xytext=(GAP_PT, height - up),
            textcoords="offset points",
            va="center",
            fontsize=8.5,
            color=INK,
            arrowprops={"arrowstyle": "-", "color": RULE} if moved else None,
            annotation_clip=False,
            bbox={"facecolor": "white", "alpha": 0.8, "linewidth": 0, "pad": 0.5},
        )
