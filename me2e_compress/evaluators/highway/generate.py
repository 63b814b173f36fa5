"""Generate routes: proposed by scenario types, admitted by the gate.

Whom the ego meets is a matter of chance. A route is admitted if the expert, who knows
only what the cameras show, solves it twice within `MOST_S`, with its own traffic and
with other, and the blind driver, who keeps one speed on the route's centre, commits an
infraction at two of the three `blind.SPEEDS_MPS`. Timing out, standing blocked and
leaving the route do not count. Both decide ten times a second, and a drive ends with
its first fault: that halves the time of an examination.
"""

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from me2e_compress.driving.contract import Policy
from me2e_compress.driving.latency import FixedLatency
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.contract import Drive
from me2e_compress.evaluators.highway.blind import SPEEDS_MPS, Blind
from me2e_compress.evaluators.highway.expert.expert_policy import Expert
from me2e_compress.evaluators.highway.runner import Listeners, drive
from me2e_compress.metrics.episode import Ending, InfractionKind
from me2e_compress.runtime.children import pool
from me2e_compress.simulator.routes import SCENARIO_ABILITIES, Route
from me2e_compress.simulator.scenarios import VARIANTS
from me2e_compress.simulator.scenarios.builders import stage_of
from me2e_compress.simulator.scene import INFRACTIONS, EventKind
from me2e_compress.simulator.traffic.stage import TRAFFIC
from me2e_compress.simulator.world import World

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


MOST_S = 80.0
"""Nobody drives for longer; two cycles of a light."""
TEN_A_SECOND = Drive(FixedLatency(100_000))
MOST_BLIND = 1
"""At how many speeds a blind driver may solve a route."""
BLIND_MPS = (SPEEDS_MPS[2], SPEEDS_MPS[1], SPEEDS_MPS[0])
"""The speeds of the blind drives, the ones that tell most first."""
FAULTS = INFRACTIONS | {EventKind.ACTOR_COLLISION}


def dry_run(route: Route, policy: Policy) -> DryRun:
    """Drive a route once, until the rest cannot change the verdict."""
    worlds = list[World]()

    def decided(world: World) -> bool:
        faults = any(event.kind in FAULTS for event in world.events)
        return faults or world.time_us >= MOST_S * 1e6

    listeners = Listeners(on_query=worlds.append)
    episode = drive(route, policy, TEN_A_SECOND, listeners, decided)
    kinds = [event.kind for event in worlds[-1].events]
    faults = [found.kind for found in episode.infractions]
    return DryRun(
        tuple(dict.fromkeys(kind for kind in faults if kind not in ENDS_ONLY)),
        episode.ending,
        EventKind.TRIGGER in kinds,
        EventKind.ACTOR_COLLISION in kinds,
        episode.frames[-1].time_us / 1e6 if episode.frames else 0.0,
        episode.failure,
    )


@dataclass(frozen=True, slots=True)
class Admission:
    """The gate's verdict on one route; without experts if blind drives solved it.

    ``again`` is the expert's drive with other traffic.
    """

    route: Route
    expert: DryRun | None
    blind: tuple[DryRun, ...]
    again: DryRun | None = None

    @property
    def refusal(self) -> str | None:
        """Why the route is not admitted, None if it is."""
        solved = list[float]()
        for speed, attempt in zip(BLIND_MPS, self.blind, strict=False):
            if not attempt.infractions:
                solved.append(speed)
            if attempt.actors_crashed:
                return f"two actors collide while the ego drives at {speed:g} m/s"
            if len(solved) > MOST_BLIND:
                speeds = " and ".join(f"{each:g}" for each in sorted(solved))
                return f"the blind driver commits no infraction at {speeds} m/s"
        if self.expert is None:
            return "the expert did not drive it"
        why = _unsolved(self.expert)
        if why is None and self.again is not None and (found := _unsolved(self.again)):
            return f"with other traffic {found}"
        # the event happens to the expert, or by chance to anybody
        drives = (self.expert, self.again, *self.blind)
        if why is None and not any(each and each.triggered for each in drives):
            return "the scenario's event never happened"
        return why

    @property
    def admitted(self) -> bool:
        """Whether the route may be used."""
        return self.refusal is None


def _unsolved(drive: DryRun) -> str | None:
    """Return how the expert failed; None if it did not."""
    if drive.actors_crashed:
        return "two actors collide while the expert drives"
    if drive.infractions:
        return f"the expert commits: {', '.join(drive.infractions)}"
    if not drive.solved:
        why = drive.failure or drive.ending.value
        return f"the expert ends after {drive.seconds:g} s: {why}"
    return None


def examine(route: Route) -> Admission:
    """Check one route; the cheap blind drives come first."""
    drives, solved = list[DryRun](), 0
    for speed in BLIND_MPS:
        drives.append(dry_run(route, Blind(speed)))
        solved += not drives[-1].infractions
        if drives[-1].actors_crashed or solved > MOST_BLIND:
            return Admission(route, None, tuple(drives))
        if len(drives) - solved == len(SPEEDS_MPS) - MOST_BLIND:
            break
    blind = tuple(drives)
    # with its own traffic and with other
    first = Admission(route, dry_run(route, Expert(cameras_only=True)), blind)
    if first.expert is not None and _unsolved(first.expert) is not None:
        return first
    again = dry_run(with_other_traffic(route), Expert(cameras_only=True))
    return replace(first, again=again)


def with_other_traffic(route: Route) -> Route:
    """Return a route with other arrivals, all else the same."""
    return replace(route, parameters={**route.parameters, TRAFFIC: OTHER_TRAFFIC})


OTHER_TRAFFIC = 1_000_003
"""Any number: the seed of the route decides beside it."""


MOST_TRIES = 20
"""Most proposals of a type per wanted route."""


@dataclass(frozen=True)
class ScenarioRoutes:
    """Admitted routes of one scenario type, and why others were refused."""

    scenario: str
    routes: tuple[Route, ...]
    refusals: tuple[str, ...]

    @property
    def tried(self) -> int:
        """Number of proposals that were put through the gate."""
        return len(self.routes) + len(self.refusals)


def propose(scenario: str, seed: int, name: str) -> Route:
    """Return a route of one of the 44 types, with every parameter written out."""
    known = SCENARIO_ABILITIES.get(scenario)
    if known is None:
        there = ", ".join(sorted(SCENARIO_ABILITIES))
        raise EvaluationError(f"no scenario {scenario!r}; there are {there}")
    route = Route(name, scenario, known[0], seed)
    return replace(route, parameters=dict(stage_of(route).parameters))


def seed_of(seed: int, scenario: str, attempt: int) -> int:
    """Return the seed of the n-th proposal of a type, different for every type."""
    words = [seed, zlib.crc32(scenario.encode()), attempt]
    return int(np.random.SeedSequence(words).generate_state(1)[0])


def admitted_routes(
    scenario: str, seed: int, variants: int = VARIANTS
) -> ScenarioRoutes:
    """Propose routes of a type until enough are admitted."""
    routes, refusals = list[Route](), list[str]()
    for attempt in range(MOST_TRIES * variants):
        name = f"{scenario}_R2_{len(routes)}"
        drawn = seed_of(seed, scenario, attempt)
        verdict = examine(propose(scenario, drawn, name))
        if verdict.refusal is None:
            routes.append(verdict.route)
        else:
            refusals.append(verdict.refusal)
        if len(routes) == variants:
            return ScenarioRoutes(scenario, tuple(routes), tuple(refusals))
    raise EvaluationError(
        f"{scenario}: {len(routes)} of {variants} routes after {len(refusals)} "
        f"refusals with seed {seed}; the last: {refusals[-1] if refusals else 'none'}"
    )


def generate(
    seed: int,
    scenarios: Sequence[str] = tuple(SCENARIO_ABILITIES),
    variants: int = VARIANTS,
    workers: int = 1,
) -> Iterator[ScenarioRoutes]:
    """Generate routes of several types, in order, whatever the number of workers."""
    of_type = partial(admitted_routes, seed=seed, variants=variants)
    if workers == 1:
        yield from map(of_type, scenarios)
        return
    with pool(workers) as processes:
        yield from processes.map(of_type, scenarios)
