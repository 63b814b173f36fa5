"""Make sets of routes: proposed by scenario types, admitted by the gate.

Whom the ego meets is a matter of chance. A route is admitted if the expert, who knows
only what the cameras show, solves it twice within `MOST_S`, with its own traffic and
with other, and the blind driver, who keeps one speed on the route's centre, commits an
infraction at two of the three `blind.SPEEDS_MPS`. Timing out, standing blocked and
leaving the route do not count. Both decide ten times a second, and a drive ends with
its first fault: that halves the time of an examination.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from me2e_compress.base import documents
from me2e_compress.base.atomic import write_document
from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.realtime import ControlClock
from me2e_compress.evaluators.highway.controller import AnchoredPlan
from me2e_compress.evaluators.highway.driven_frames import propose, seed_of
from me2e_compress.evaluators.highway.episode_recorder import EpisodeRecorder
from me2e_compress.evaluators.highway.observe import ObservationBuilder
from me2e_compress.evaluators.highway.runner import EndingRules
from me2e_compress.metrics.episode import Ending, InfractionKind
from me2e_compress.simulator.camera_rig import CameraRig
from me2e_compress.simulator.routes import (
    ROAD_VERSION,
    SCENARIO_ABILITIES,
    Route,
    save_routes,
)
from me2e_compress.simulator.scene import INFRACTIONS, Control, EventKind
from me2e_compress.simulator.traffic.stage import TRAFFIC
from me2e_compress.simulator.world import World
from me2e_compress.version import __version__
from models.driver.expert import Expert
from models.driver.expert.blind import SPEEDS_MPS, Blind
from models.processes import process_pool

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

    @property
    def solved(self) -> bool:
        """Whether the goal was reached without an infraction."""
        return self.ending is Ending.COMPLETED and not self.infractions


VARIANTS = 5
"""Routes of each type, as in Bench2Drive's 220."""
MOST_S = 80.0
"""Nobody drives for longer; two cycles of a light."""
DECISION_US = 100_000
"""What a decision takes."""
MOST_BLIND = 1
"""At how many speeds a blind driver may solve a route."""
BLIND_MPS = (SPEEDS_MPS[2], SPEEDS_MPS[1], SPEEDS_MPS[0])
"""The speeds of the blind drives, the ones that tell most first."""
FAULTS = INFRACTIONS | {EventKind.ACTOR_COLLISION}


def dry_run(route: Route, policy: Blind | Expert) -> DryRun:
    """Drive a route once, until the rest cannot change the verdict."""
    world, rules = World(route), EndingRules()
    observer = ObservationBuilder(world, policy, CameraRig(), None)
    clock, ending = ControlClock(Control(0.0, 0.0)), None
    policy.reset(route)
    scene = world.scene()
    while ending is None:
        if clock.decision_is_due:
            plan = policy.plan(observer.observe(scene))
            anchored = AnchoredPlan.of(plan, scene.ego, scene.time_us)
            clock.decide(anchored.control(scene.ego, scene.time_us), DECISION_US)
        world.step(clock.advance())
        scene = world.scene()
        ending = rules.ending(world, scene.ego.speed_mps)
        at_fault = any(event.kind in FAULTS for event in world.events)
        if ending is None and (at_fault or world.time_us >= MOST_S * 1e6):
            ending = Ending.TIMEOUT
    faults = [each.kind for each in EpisodeRecorder(world).episode(ending).infractions]
    kinds = [event.kind for event in world.events]
    return DryRun(
        tuple(dict.fromkeys(kind for kind in faults if kind not in ENDS_ONLY)),
        ending,
        EventKind.TRIGGER in kinds,
        EventKind.ACTOR_COLLISION in kinds,
        world.time_us / 1e6,
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
        return f"the expert ends after {drive.seconds:g} s: {drive.ending.value}"
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
    with process_pool(workers) as processes:
        yield from processes.map(of_type, scenarios)


def make_routes(
    path: Path,
    seed: int,
    scenarios: Sequence[str] = tuple(SCENARIO_ABILITIES),
    variants: int = VARIANTS,
    workers: int = 1,
    on_done: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[ScenarioRoutes, ...]:
    """Write a set of admitted routes; it goes on where it was killed.

    Args:
        path: the manifest; ``PATH.part`` beside it holds the types that are done.
        seed: of everything random.
        scenarios: the types.
        variants: routes of each type.
        workers: processes.
        on_done: called with the types done and their total.

    Raises:
        EvaluationError: a type has no such routes, or the draft is of other options.
    """
    deciding = {
        "version": f"{__version__}, road version {ROAD_VERSION}",
        "seed": seed,
        "variants": variants,
    }
    draft = path.with_name(f"{path.name}.part")
    harvests = dict[str, ScenarioRoutes]()
    # what an earlier run has done
    if draft.exists():
        with documents.reading(draft, EvaluationError, "not a set that was begun"):
            content = documents.read_bytes(draft)
            record = TypeAdapter(dict[str, Any]).validate_json(content)
            for key, wanted in deciding.items():
                if record.get(key) != wanted:
                    raise EvaluationError(
                        f"{draft}: is a set that was begun with {key}"
                        f" {record.get(key)}, not {wanted}; delete it, or choose"
                        " another name"
                    )
            done = TypeAdapter(list[ScenarioRoutes])
            begun = done.validate_python(record.get("done"))
        harvests = {one.scenario: one for one in begun}
    # each type is kept as soon as its routes are admitted
    missing = [name for name in scenarios if name not in harvests]
    for harvest in generate(seed, missing, variants, workers):
        harvests[harvest.scenario] = harvest
        kept = [asdict(one) for one in harvests.values()]
        write_document(draft, deciding | {"done": kept})
        on_done(len(harvests), len(scenarios))
    ordered = tuple(harvests[name] for name in scenarios)
    save_routes([route for one in ordered for route in one.routes], path)
    draft.unlink(missing_ok=True)
    return ordered
