"""A driver's successive plans before its own accident (the paper's figure 6)."""

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydantic import ConfigDict, TypeAdapter, ValidationError, with_config

from me2e_compress import documents
from me2e_compress.errors import StudyError
from me2e_compress.evaluators.highway.runner import Listeners, drive
from me2e_compress.evaluators.highway.worker import Job
from me2e_compress.metrics.infraction import COLLISIONS, InfractionKind
from me2e_compress.runtime.atomic import write_json
from me2e_compress.simulator.pictures import Moment
from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.scene import Actor, Ego
from me2e_compress.simulator.world import World
from me2e_compress.study.drive_record import DriveRecord, RouteSummary

FILE = "accident.json"
BEFORE_US, EVERY_US = 3_000_000, 500_000
"""The last three seconds, twice a second."""
NEAR_M = 40.0
"""Road users no farther than this are kept."""

_STRICT = ConfigDict(allow_inf_nan=False, extra="forbid")
Point = tuple[float, float]


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
        try:
            write_json(path, _ACCIDENT.dump_python(self, mode="json"))
        except OSError as error:
            raise StudyError(f"{path}: cannot be written: {error.strerror}") from error

    @classmethod
    def load(cls, path: Path) -> "Accident":
        """Read a file that `save` wrote."""
        try:
            content = documents.from_json(documents.content(path))
            return _ACCIDENT.validate_python(content)
        except OSError as error:
            raise StudyError(f"{path}: cannot be read: {error.strerror}") from error
        except (ValueError, ValidationError) as error:
            words = " ".join(str(error).split())[:200]
            raise StudyError(f"{path}: not an accident: {words}") from error


_ACCIDENT = TypeAdapter(Accident)


def first_accident(record: DriveRecord) -> RouteSummary | None:
    """Return the first route that ended in a collision with a moving actor."""
    moving = (InfractionKind.COLLISION_VEHICLE, InfractionKind.COLLISION_PEDESTRIAN)
    for each in record.routes:
        kinds = [kind for kind, _ in each.collisions]
        if kinds and kinds[0] in moving and each.duration_us > BEFORE_US:
            return each
    return None


def watched(
    record: DriveRecord, happened: RouteSummary, route: Route, job: Job
) -> Accident:
    """Drive the route of an accident again, and keep its last seconds."""
    film = _LastSeconds(happened.duration_us - BEFORE_US)
    drive(route, job.driver.open(), job.conditions, Listeners(on_moment=film.see))
    partner = next(who for kind, _, who in happened.infractions if kind in COLLISIONS)
    points = World(route).path.points
    return Accident(
        record.variant,
        record.condition,
        route.id,
        route.scenario,
        partner,
        tuple((float(x), float(y)) for x, y in points),
        tuple(film.kept),
    )


@dataclass
class _LastSeconds:
    """Keeps two moments per second, counted back from the end, and the last one."""

    from_us: int
    kept: list[PlannedMoment] = field(default_factory=list)

    def see(self, moment: Moment) -> None:
        since_us = moment.scene.time_us - self.from_us
        if since_us >= 0 and since_us % EVERY_US == 0:
            self.kept.append(_planned(moment))


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
