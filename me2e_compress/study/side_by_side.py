"""Pictures of the moment at which two drives of a route diverge."""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from me2e_compress.evaluators.highway.runner import Listeners, drive
from me2e_compress.evaluators.highway.worker import Job
from me2e_compress.metrics.route_summary import RouteSummary
from me2e_compress.simulator.cameras import paint_texture
from me2e_compress.simulator.pictures.route import (
    Moment,
    RoutePicture,
    overlay,
    write_png,
)
from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.world import World
from me2e_compress.study.condition import Condition
from me2e_compress.study.drive_record import Apart, DriveRecord
from me2e_compress.study.drives import DriveSetup
from me2e_compress.study.prepared import PreparedVariant

SCORED, MOVED_M = 1.0, 0.5
"""Two drives whose scores are closer, and that were never farther apart, look alike."""

_FORGOTTEN = np.zeros((0, 0, 0, 3), np.uint8)


@dataclass(frozen=True)
class RoutePair:
    """One route as two drivers drove it: ``route`` is the baseline's."""

    drive: DriveRecord
    route: RouteSummary
    other: RouteSummary

    @property
    def apart(self) -> Apart:
        """How far the two were from each other at most."""
        return self.drive.apart.get(self.other.route, Apart(0.0, 0))

    @property
    def gap(self) -> float:
        """How far the driving scores differ."""
        return abs(self.route.driving_score - self.other.driving_score)

    @property
    def seen(self) -> bool:
        """Whether both drives have frames; a hung or crashed one has none."""
        return bool(self.route.duration_us and self.other.duration_us)

    @property
    def differs(self) -> bool:
        """Whether a reader can see that the two are not alike."""
        return self.gap >= SCORED or self.apart.distance_m > MOVED_M

    @property
    def rank(self) -> tuple[float, float]:
        """Order of pictures: the widest gap first."""
        return -self.gap, -self.apart.distance_m

    @property
    def moment_us(self) -> int:
        """Time of the worse drive's infraction, else of the greatest distance."""
        if self.gap < SCORED:
            return self.apart.time_us
        worse, better = self.route, self.other
        if worse.driving_score > better.driving_score:
            worse, better = better, worse
        kinds = [kind for kind, _ in better.moments]
        timed = [(kind, us) for kind, us in worse.moments if us is not None]
        alone = [us for kind, us in timed if kind not in kinds]
        times = alone or [us for _, us in timed]
        return times[0] if times else min(worse.duration_us, better.duration_us)


@dataclass(frozen=True)
class Contrast(RoutePair):
    """A PNG of the moment of two drives: the baseline in grey under the variant."""

    picture: Path


def take_pictures(
    setup: DriveSetup,
    prepared: Sequence[PreparedVariant],
    drives: Sequence[DriveRecord],
    limit: int,
) -> tuple[Contrast, ...]:
    """Drive the routes on which variants diverge the most again, up to the moment.

    Existing pictures are reused; no route is shown twice, and variants alternate.
    """
    # look-ups by the names in the drives
    found = list[Contrast]()
    by_name = {each.variant.name: each for each in prepared}
    conditions = {each.name: each for each in setup.study.conditions}
    routes = {each.id: each for each in setup.study.routes}
    # one picture per chosen pair
    pairs = _chosen(setup.study.baseline, drives, limit)
    for done, pair in enumerate(pairs):
        setup.listener.on_progress("pictures", done, len(pairs), pair.route.route)
        condition = conditions[pair.drive.condition]
        where = routes[pair.route.route]
        both = by_name[pair.drive.variant], by_name[setup.study.baseline]
        picture = _picture(setup, *both, condition, where, pair.moment_us)
        found.append(Contrast(pair.drive, pair.route, pair.other, picture))
    return tuple(found)


def _chosen(
    baseline: str, drives: Sequence[DriveRecord], limit: int
) -> list[RoutePair]:
    """Choose the widest gaps: one of each variant first, and no route twice."""
    references = {each.condition: each for each in drives if each.variant == baseline}
    pairs = [
        RoutePair(drive, route, other)
        for drive in drives
        if drive.variant != baseline and drive.routes
        for route, other in zip(
            references[drive.condition].routes, drive.routes, strict=True
        )
    ]
    ranked = sorted((pair for pair in pairs if pair.seen), key=lambda p: p.rank)
    # Where all look alike, one picture shows just that.
    ranked = [pair for pair in ranked if pair.differs] or ranked[:1]
    chosen = list[RoutePair]()
    for others_only in (True, False):
        for pair in ranked:
            shown = [each.drive.variant for each in chosen]
            if len(chosen) == limit or (others_only and pair.drive.variant in shown):
                continue
            if pair.route.route not in [each.route.route for each in chosen]:
                chosen.append(pair)
    return chosen


def _picture(
    setup: DriveSetup,
    variant: PreparedVariant,
    baseline: PreparedVariant,
    condition: Condition,
    route: Route,
    time_us: int,
) -> Path:
    """Drive both up to a moment and overlay them, unless the picture exists."""
    path = setup.workspace.picture(variant.variant, condition, route.id, time_us)
    jobs = [setup.job(each, condition) for each in (variant, baseline)]
    if path.is_file() or None in jobs:
        return path
    world = World(route)
    points = world.path.points
    texture = paint_texture(world.roadmap, points)
    drives = [
        RoutePicture(each.variant.name, texture, points, watch(job, route, time_us))
        for each, job in zip((variant, baseline), jobs, strict=True)
        if job is not None
    ]
    write_png(path, overlay(*drives))
    return path


class _Enough(Exception):  # noqa: N818 - it ends a drive, nothing went wrong
    """Ends a drive once the moment was seen."""


def watch(job: Job, route: Route, until_us: int) -> list[Moment]:
    """Drive a route, and return its moments; only the last one has camera images."""
    moments = list[Moment]()

    def see(moment: Moment) -> None:
        if moments:
            moments[-1] = replace(moments[-1], images=_FORGOTTEN)
        moments.append(moment)
        if moment.scene.time_us >= until_us:
            raise _Enough

    with contextlib.suppress(_Enough):
        drive(route, job.driver.open(), job.conditions, Listeners(on_moment=see))
    return moments
