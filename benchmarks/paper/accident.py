"""A driver's successive plans before its own accident (the paper's figure 6)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from pydantic import ConfigDict, TypeAdapter, with_config

from me2e_compress.base import atomic, documents
from me2e_compress.base.atomic import write_json
from me2e_compress.base.errors import StudyError
from me2e_compress.metrics.episode import COLLISIONS, InfractionKind
from me2e_compress.metrics.route_summary import RouteSummary
from me2e_compress.simulator.pictures import Moment
from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.scene import Actor, Ego
from me2e_compress.simulator.world import World
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.report.figures import MUTED, RULE, WIDTH_IN, styled

FILE = "accident.json"
BEFORE_US, EVERY_US = 3_000_000, 500_000
"""The last three seconds, twice a second."""
NEAR_M = 40.0
"""Road users no farther than this are kept."""

MARGIN_M = 8.0
"""Around what the figure shows."""

_STRICT = ConfigDict(allow_inf_nan=False, extra="forbid")
Point = tuple[float, float]
Floats = npt.NDArray[np.float64]


@with_config(_STRICT)
@dataclass(frozen=True)
class SeenBox:
    """A road user seen from above: metres and radians in the world."""

    kind: str
    x: float
    y: float
    heading: float
    length: float
    width: float


@with_config(_STRICT)
@dataclass(frozen=True)
class PlannedMoment:
    """The road users at one moment, and the ego's waypoints in the world, if any."""

    time_us: int
    ego: SeenBox
    plan: tuple[Point, ...]
    others: tuple[SeenBox, ...]


@with_config(_STRICT)
@dataclass(frozen=True)
class Accident:
    """The last seconds of a route, up to a collision, with its centre line."""

    variant: str
    condition: str
    route: str
    scenario: str
    partner: str
    path: tuple[Point, ...]
    moments: tuple[PlannedMoment, ...]

    def save(self, path: Path) -> None:
        """Write it as JSON."""
        with atomic.writing_errors(path, StudyError):
            write_json(path, _ACCIDENT.dump_python(self, mode="json"))

    @classmethod
    def load(cls, path: Path) -> "Accident":
        """Read a file that `save` wrote."""
        with documents.reading(path, StudyError, "not an accident"):
            content = documents.from_json(documents.read_bytes(path))
            return _ACCIDENT.validate_python(content)


_ACCIDENT = TypeAdapter(Accident)


def first_accident(record: DriveRecord) -> RouteSummary | None:
    """Return the first route that ended in a collision with a moving actor."""
    moving = (InfractionKind.COLLISION_VEHICLE, InfractionKind.COLLISION_PEDESTRIAN)
    for each in record.routes:
        kinds = [kind for kind, _ in each.collisions]
        if kinds and kinds[0] in moving and each.duration_us > BEFORE_US:
            return each
    return None


def accident_of(
    record: DriveRecord, happened: RouteSummary, route: Route, seen: Sequence[Moment]
) -> Accident:
    """Return the last seconds of a route that was driven again."""
    from_us = happened.duration_us - BEFORE_US
    moments = (
        _planned(each)
        for each in seen
        if (since_us := each.scene.time_us - from_us) >= 0 and not since_us % EVERY_US
    )
    partner = next(who for kind, _, who in happened.infractions if kind in COLLISIONS)
    points = World(route).path.points
    return Accident(
        record.variant,
        record.condition,
        route.id,
        route.scenario,
        partner,
        tuple((float(x), float(y)) for x, y in points),
        tuple(moments),
    )


def _planned(moment: Moment) -> PlannedMoment:
    ego, plan = moment.scene.ego, moment.plan
    others = (
        _box(each.kind.value, each)
        for each in moment.scene.actors
        if math.hypot(each.x - ego.x, each.y - ego.y) <= NEAR_M
    )
    waypoints = () if plan is None else _in_world(plan, ego.x, ego.y, ego.heading)
    time_us = moment.scene.time_us
    return PlannedMoment(time_us, _box("ego", ego), waypoints, tuple(others))


def _box(kind: str, seen: Ego | Actor) -> SeenBox:
    x, y, heading = round(seen.x, 3), round(seen.y, 3), round(seen.heading, 4)
    return SeenBox(kind, x, y, heading, seen.length, seen.width)


def _in_world(
    plan: np.ndarray[tuple[int, ...], np.dtype[np.floating]],
    x: float,
    y: float,
    heading: float,
) -> tuple[Point, ...]:
    cos, sin = math.cos(heading), math.sin(heading)
    turned = np.asarray(plan) @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
    return tuple((round(float(a), 3), round(float(b), 3)) for a, b in turned)


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
