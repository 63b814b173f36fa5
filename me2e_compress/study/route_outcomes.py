"""Outcome of each route, and where two drives of it diverge."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from me2e_compress.metrics.driving_score import route_score
from me2e_compress.metrics.episode import Episode
from me2e_compress.metrics.infraction import InfractionKind

WORDS = {
    InfractionKind.COLLISION_PEDESTRIAN: "collision with a pedestrian",
    InfractionKind.COLLISION_VEHICLE: "collision with a vehicle",
    InfractionKind.COLLISION_LAYOUT: "collision with an obstacle",
    InfractionKind.RED_LIGHT: "red light",
    InfractionKind.STOP: "stop sign",
    InfractionKind.GIVE_WAY: "give-way sign",
    InfractionKind.OUTSIDE_ROUTE_LANES: "outside its lanes",
    InfractionKind.MIN_SPEED: "too slow",
    InfractionKind.YIELD_TO_EMERGENCY_VEHICLE: "no way for an emergency vehicle",
    InfractionKind.SCENARIO_TIMEOUT: "scenario timed out",
    InfractionKind.ROUTE_DEVIATION: "left the route",
    InfractionKind.VEHICLE_BLOCKED: "blocked",
    InfractionKind.ROUTE_TIMEOUT: "timed out",
}


@dataclass(frozen=True)
class RouteOutcome:
    """One route of one drive.

    Attributes:
        driving_score: Percent.
        infractions: Kind and time in microseconds, in order of time, None if unknown.
        duration_us: Time of the last frame.
        apart_m: Greatest distance to the baseline's ego at the same time, and
            ``apart_us`` its time; None for the baseline itself and for a route without
            frames.
    """

    route: str
    scenario: str
    driving_score: float
    succeeded: bool
    ending: str
    infractions: tuple[tuple[str, int | None], ...]
    duration_us: int
    apart_m: float | None = None
    apart_us: int | None = None

    @property
    def fate(self) -> str:
        """The infractions in words, or how the route ended."""
        kinds = [WORDS[InfractionKind(kind)] for kind, _ in self.infractions]
        return ", ".join(dict.fromkeys(kinds)) or self.ending

    def to_json(self) -> dict[str, Any]:
        """Return a flat object; infractions as a list of kind and time."""
        return {
            "route": self.route,
            "driving_score": self.driving_score,
            "succeeded": self.succeeded,
            "ending": self.ending,
            "infractions": [
                {"kind": kind, "time_us": time_us} for kind, time_us in self.infractions
            ],
            "apart_m": self.apart_m,
        }


def outcomes(
    episodes: Sequence[Episode], reference: Sequence[Episode] | None
) -> tuple[RouteOutcome, ...]:
    """Summarize a drive by route; ``reference`` is None for the baseline's own."""
    if reference is None:
        return tuple(_outcome(each, None, None) for each in episodes)
    return tuple(
        _outcome(each, *_apart(each, other))
        for each, other in zip(episodes, reference, strict=True)
    )


def _outcome(
    episode: Episode, apart_m: float | None, apart_us: int | None
) -> RouteOutcome:
    return RouteOutcome(
        episode.route,
        episode.scenario,
        route_score(episode).composed,
        episode.succeeded,
        episode.ending.value,
        tuple(
            (each.kind.value, each.time_us)
            for each in episode.infractions
            if each.kind is not InfractionKind.MIN_SPEED
        ),
        episode.frames[-1].time_us if episode.frames else 0,
        apart_m,
        apart_us,
    )


def _apart(one: Episode, other: Episode) -> tuple[float | None, int | None]:
    """Return the greatest distance at the same time, metres, and that time."""
    count = min(len(one.frames), len(other.frames))
    if not count:
        return None, None
    here, there = (
        np.array([(frame.x, frame.y) for frame in each.frames[:count]])
        for each in (one, other)
    )
    gaps = np.hypot(*(here - there).T)
    at = int(gaps.argmax())
    return float(gaps[at]), one.frames[at].time_us
