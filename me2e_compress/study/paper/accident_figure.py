"""The paper's figure 6: plans before an accident, seen from above."""

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from me2e_compress.study.paper.accident import Accident, PlannedMoment, SeenBox
from me2e_compress.study.report.figures import WIDTH_IN
from me2e_compress.study.report.style import MUTED, RULE, styled

Floats = npt.NDArray[np.float64]

MARGIN_M = 8.0


def plans_before(accident: Accident) -> Figure:
    """Draw all moments in the frame of the ego at the last one, later ones darker."""
    with styled():
        # the road, in the ego's frame at the collision
        figure = Figure(figsize=(WIDTH_IN, 3.6), layout="constrained")
        axes = figure.subplots()
        here = accident.moments[-1].ego
        axes.plot(
            *_seen(accident.path, here).T,
            color=RULE,
            linewidth=9,
            solid_capstyle="round",
            zorder=0,
        )
        # later moments are darker
        shades = colormaps["viridis_r"](np.linspace(0.1, 1.0, len(accident.moments)))
        last_us = accident.moments[-1].time_us
        for moment, shade in zip(accident.moments, shades, strict=True):
            _moment(axes, moment, here, shade, moment.time_us - last_us)
        _frame(axes, accident.moments, here)
        # legend beside the plot, title above
        axes.legend(
            frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5)
        )
        axes.set_title(
            f"{accident.variant}, {accident.condition}, {accident.route}: plans before"
            f" the collision with {accident.partner}",
            color=MUTED,
        )
        axes.set_xlabel("metres ahead of where it hit")
        return figure


def _moment(
    axes: Axes,
    moment: PlannedMoment,
    here: SeenBox,
    shade: Sequence[float],
    until_us: int,
) -> None:
    colour = tuple(shade)
    _draw(axes, moment.ego, here, colour, filled=True)
    for other in moment.others:
        _draw(axes, other, here, colour, filled=False)
    if moment.plan:
        start = _seen([(moment.ego.x, moment.ego.y), *moment.plan], here)
        axes.plot(
            *start.T,
            "o-",
            color=colour,
            markersize=3,
            linewidth=1.3,
            label=f"{until_us / 1e6:+.1f} s" if until_us else "collision",
        )


def _draw(
    axes: Axes, box: SeenBox, here: SeenBox, colour: tuple[float, ...], *, filled: bool
) -> None:
    cos, sin = math.cos(box.heading), math.sin(box.heading)
    half = np.array([box.length, box.width]) / 2
    signs = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)])
    corners = (signs * half) @ np.array([[cos, sin], [-sin, cos]]) + (box.x, box.y)
    axes.add_patch(
        Polygon(
            _seen(corners, here),
            closed=True,
            facecolor=(*colour[:3], 0.25) if filled else "none",
            edgecolor=colour if filled else (*colour[:3], 0.7),
            linewidth=1.2 if filled else 0.9,
            linestyle="-" if filled else ":",
        )
    )


def _seen(points: npt.ArrayLike, here: SeenBox) -> Floats:
    """Convert points from the world to a box's frame, x forward, y left."""
    cos, sin = math.cos(here.heading), math.sin(here.heading)
    moved = np.asarray(points, np.float64) - (here.x, here.y)
    return np.asarray(moved @ np.array([[cos, -sin], [sin, cos]]))


def _frame(axes: Axes, moments: Sequence[PlannedMoment], here: SeenBox) -> None:
    """Limit the view to the ego's way and plans, with a margin."""
    driven = [(moment.ego.x, moment.ego.y) for moment in moments]
    planned = [point for moment in moments for point in moment.plan]
    points = _seen([*driven, *planned], here)
    low, high = points.min(axis=0) - MARGIN_M, points.max(axis=0) + MARGIN_M
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
