"""Curves of driving scores over the conditions."""

from collections.abc import Callable, Sequence

from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from me2e_compress.metrics.measure import Estimate
from me2e_compress.metrics.scores import Scores
from me2e_compress.study.outcome import StudyOutcome
from me2e_compress.study.report.figures import WIDTH_IN
from me2e_compress.study.report.style import ACCENT, BASELINE, MUTED, styled, svg

ENOUGH = 3
"""Fewest conditions that make a curve; fewer are read off the tables."""

Score = Callable[[Scores], Estimate]


def curves(outcome: StudyOutcome) -> Markup | None:
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
                _curve(axes, variant.name, _found(outcome, variant.name, pick), outcome)
            axes.set_title(title, color=MUTED)
            axes.set_xticks(range(len(names)), names)
            axes.set_ylim(0.0, 102.0)
            axes.grid(visible=True, axis="y")
            axes.spines["left"].set_visible(False)
        return svg(figure)


def _found(
    outcome: StudyOutcome, variant: str, pick: Score
) -> Sequence[Estimate | None]:
    """Return one estimate per condition; None if the variant was not driven."""
    return [
        None if drive.scores is None else pick(drive.scores)
        for drive in outcome.drives
        if drive.variant == variant
    ]


def _curve(
    axes: Axes, name: str, found: Sequence[Estimate | None], outcome: StudyOutcome
) -> None:
    # conditions under which the variant was driven
    colour = BASELINE if name == outcome.study.baseline else ACCENT
    driven = [
        (place, each.value, each.low, each.high)
        for place, each in enumerate(found)
        if each is not None and each.value is not None
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
