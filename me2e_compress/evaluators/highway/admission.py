"""The admission gate: routes that a blind driver solves are rejected.

A route is admitted if the privileged expert solves it and the blind driver, who keeps
one speed on the route's centre, commits an infraction at every one of
`blind.SPEEDS_MPS`. Timing out, standing blocked and leaving the route do not count.
"""

from dataclasses import dataclass

from me2e_compress.driving.contract import Policy
from me2e_compress.evaluators.highway.blind import SPEEDS_MPS, Blind
from me2e_compress.evaluators.highway.conditions import Conditions
from me2e_compress.evaluators.highway.expert import Expert
from me2e_compress.evaluators.highway.runner import Listeners, drive
from me2e_compress.metrics.episode import Ending
from me2e_compress.metrics.infraction import InfractionKind
from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.world import Event, EventKind, World

ENDS_ONLY = (
    InfractionKind.ROUTE_TIMEOUT,
    InfractionKind.VEHICLE_BLOCKED,
    InfractionKind.ROUTE_DEVIATION,
)
"""Infractions that only mean that the route was not finished: the gate ignores them."""


@dataclass(frozen=True, slots=True)
class DryRun:
    """How one drive of one route went.

    ``infractions`` are distinct, in order and without `ENDS_ONLY`; a collision of two
    actors is a fault of the scenario.
    """

    infractions: tuple[InfractionKind, ...]
    ending: Ending
    triggered: bool
    actors_crashed: bool
    seconds: float
    failure: str | None = None

    @property
    def solved(self) -> bool:
        """Whether the goal was reached without an infraction."""
        return self.ending is Ending.COMPLETED and not self.infractions


def dry_run(route: Route, policy: Policy) -> DryRun:
    """Drive a route once with a policy that decides at every frame."""
    seen = _WorldListener()
    episode = drive(route, policy, Conditions(), Listeners(on_query=seen.watch))
    kinds = [event.kind for event in seen.events]
    faults = [found.kind for found in episode.infractions]
    return DryRun(
        tuple(dict.fromkeys(kind for kind in faults if kind not in ENDS_ONLY)),
        episode.ending,
        EventKind.TRIGGER in kinds,
        EventKind.ACTOR_COLLISION in kinds,
        episode.frames[-1].time_us / 1e6 if episode.frames else 0.0,
        episode.failure,
    )


class _WorldListener:
    def __init__(self) -> None:
        self._world: World | None = None

    def watch(self, world: World) -> None:
        self._world = world

    @property
    def events(self) -> tuple[Event, ...]:
        return () if self._world is None else self._world.events


@dataclass(frozen=True, slots=True)
class Admission:
    """The gate's verdict on one route; without expert if a blind drive solved it."""

    route: Route
    expert: DryRun | None
    blind: tuple[DryRun, ...]

    @property
    def refusal(self) -> str | None:
        """Why the route is not admitted, None if it is."""
        for speed, attempt in zip(SPEEDS_MPS, self.blind, strict=False):
            if not attempt.infractions:
                return f"the blind driver commits no infraction at {speed:g} m/s"
            if attempt.actors_crashed:
                return f"two actors collide while the ego drives at {speed:g} m/s"
        if self.expert is None:
            return "the expert did not drive it"
        if self.expert.actors_crashed:
            return "two actors collide while the expert drives"
        if self.expert.infractions:
            return f"the expert commits: {', '.join(self.expert.infractions)}"
        if not self.expert.solved:
            why = self.expert.failure or self.expert.ending.value
            return f"the expert ends after {self.expert.seconds:g} s: {why}"
        if not self.expert.triggered:
            return "the scenario's event never happened"
        return None

    @property
    def admitted(self) -> bool:
        """Whether the route may be used."""
        return self.refusal is None


def examine(route: Route) -> Admission:
    """Check one route; the cheap blind drives come first."""
    drives = list[DryRun]()
    for speed in SPEEDS_MPS:
        drives.append(dry_run(route, Blind(speed)))
        if not drives[-1].infractions:
            return Admission(route, None, tuple(drives))
    return Admission(route, dry_run(route, Expert()), tuple(drives))
