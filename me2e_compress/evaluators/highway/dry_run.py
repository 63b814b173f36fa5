"""Drive a route once, without cameras or latency, and say in short how it went."""

from dataclasses import dataclass

from me2e_compress.driving.contract import Policy
from me2e_compress.evaluators.highway.runner import Conditions, Listeners, drive
from me2e_compress.metrics.episode import Ending
from me2e_compress.metrics.infraction import InfractionKind
from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.world import Event, EventKind, World

ENDS_ONLY = (
    InfractionKind.ROUTE_TIMEOUT,
    InfractionKind.VEHICLE_BLOCKED,
    InfractionKind.ROUTE_DEVIATION,
)
"""What says only that a route was not finished; no infraction for the gate."""


@dataclass(frozen=True, slots=True)
class DryRun:
    """How one drive of one route went.

    Attributes:
        infractions: Kinds of infractions in order, none repeated, none of `ENDS_ONLY`.
        ending: Why the route ended.
        triggered: Whether the scenario's event happened.
        actors_crashed: Whether two actors collided: a fault of the scenario.
        seconds: Simulated time at the end.
        failure: What the policy raised, if it did.
    """

    infractions: tuple[InfractionKind, ...]
    ending: Ending
    triggered: bool
    actors_crashed: bool
    seconds: float
    failure: str | None = None

    @property
    def solved(self) -> bool:
        """Goal reached and nothing done wrong."""
        return self.ending is Ending.COMPLETED and not self.infractions


def dry_run(route: Route, policy: Policy) -> DryRun:
    """Drive a route with a privileged policy that decides at every frame."""
    seen = _Witness()
    episode = drive(route, policy, Conditions(), Listeners(asking=seen.watch))
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


class _Witness:
    """Keeps hold of the world that the runner drives in."""

    def __init__(self) -> None:
        self._world: World | None = None

    def watch(self, world: World) -> None:
        self._world = world

    @property
    def events(self) -> tuple[Event, ...]:
        return () if self._world is None else self._world.events
