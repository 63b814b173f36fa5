"""The expert, through the controller, on the real world."""

from dataclasses import replace

import numpy as np
import pytest

from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.realtime import ControlClock
from me2e_compress.evaluators.highway.controller import AnchoredPlan
from me2e_compress.evaluators.highway.driven_frames import propose, seed_of
from me2e_compress.metrics.episode import Ending, InfractionKind
from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.routes import (
    Route,
    load_routes,
    pick_routes,
)
from me2e_compress.simulator.scene import INFRACTIONS, Control
from me2e_compress.simulator.world import World
from models.driver import admission as room
from models.driver.admission import (
    Admission,
    DryRun,
    admitted_routes,
    dry_run,
    examine,
    generate,
)
from models.driver.expert.expert_policy import (
    Expert,
    Memory,
    ceiling,
    decide,
)
from models.driver.expert.privileged import privileged
from tests.simulator.world.driving import route_of

SEED = 77_001


def route(scenario: str, seed: int = SEED) -> Route:
    return Route(f"{scenario}-{seed}", scenario, seed)


QUICK = (
    *("AccidentTwoWays", "PedestrianCrossing", "YieldToEmergencyVehicle"),
    "VanillaSignalizedTurnEncounterRedLight",
)
SLOW = (
    *("EnterActorFlow", "SequentialLaneChange"),
    "VanillaNonSignalizedTurnEncounterStopsign",
)


@pytest.mark.parametrize(
    "scenario",
    [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)],
)
def test_it_solves_a_fresh_route_of(scenario: str) -> None:
    drive = dry_run(route(scenario), Expert())
    assert drive.solved, drive


def test_the_planned_waypoints_are_where_the_ego_then_is() -> None:
    """The plan of a moment is driven: within 0.5 m after a second on a ring."""
    world, memory = World(route("EnterActorFlow")), Memory()
    top, misses = ceiling(world.path), list[float]()
    planned = list[Floats]()
    while not world.done and world.time_us < 40_000_000:
        scene = world.scene()
        decision = decide(scene, privileged(world), world.path, top, memory)
        memory = decision.memory
        plan = AnchoredPlan.of(decision.waypoints, scene.ego, scene.time_us)
        planned.append(scene.ego.placed(np.asarray(decision.waypoints, float))[1])
        world.step(plan.control(scene.ego, scene.time_us))
        if len(planned) > 20:
            x, y = planned[-21]
            misses.append(float(np.hypot(scene.ego.x - x, scene.ego.y - y)))
    assert np.median(misses) < 0.3
    assert np.quantile(misses, 0.9) < 1.0


def test_a_decision_that_takes_long_drives_worse() -> None:
    """Nobody drives a ring whose every control is 0.85 s old."""
    held = ControlClock(Control(0.0, 0.0))
    world, memory = World(route("EnterActorFlow")), Memory()
    top = ceiling(world.path)
    while not world.done and world.time_us < 40_000_000:
        if held.decision_is_due:
            scene = world.scene()
            decision = decide(scene, privileged(world), world.path, top, memory)
            memory = decision.memory
            plan = AnchoredPlan.of(decision.waypoints, scene.ego, scene.time_us)
            control = plan.control(scene.ego, scene.time_us)
            held.decide(control, 850_000)
        world.step(held.advance())
    wrong = [event.kind for event in world.events if event.kind in INFRACTIONS]
    assert wrong or not world.done


SAMPLE = pick_routes(load_routes(), "11")
HIT = (InfractionKind.COLLISION_VEHICLE,)
SOLVED = DryRun((), Ending.COMPLETED, True, False, 20.0)
FAILED = DryRun(HIT, Ending.COLLISION, True, False, 9.0)
UNMET = replace(SOLVED, triggered=False)
LATE = DryRun((), Ending.BLOCKED, True, False, 75.0)


@pytest.mark.parametrize(
    "route",
    [
        pytest.param(route, id=route.id, marks=pytest.mark.slow if index else ())
        for index, route in enumerate(SAMPLE)
    ],
)
def test_what_ships_is_admitted(route: object) -> None:
    verdict = examine(next(one for one in SAMPLE if one is route))

    assert verdict.refusal is None
    assert len(verdict.blind) >= 2


def test_a_route_without_its_event_is_refused() -> None:
    verdict = examine(route_of("VehicleOpensDoorTwoWays", 1, door_m=1000.0))

    assert "the scenario's event never happened" in str(verdict.refusal)


def test_a_proposal_writes_out_every_parameter() -> None:
    route = propose("EnterActorFlow", 5, "mine")

    assert route.parameters == World(route).parameters
    assert route.parameters == World(replace(route, seed=99)).parameters


def test_a_proposal_of_an_unknown_type() -> None:
    with pytest.raises(EvaluationError, match="no scenario 'Flying'; there are"):
        propose("Flying", 0, "mine")


def test_a_harvest_is_the_same_each_time_and_for_any_workers() -> None:
    names = ("DynamicObjectCrossing", "ParkedObstacle")
    once = [admitted_routes(name, 3, 1) for name in names]

    assert list(generate(3, names, 1, workers=2)) == once
    assert once[0].routes[0].id == "DynamicObjectCrossing_R2_0"
    assert once[0].tried == 1 + len(once[0].refusals)


def test_every_type_and_attempt_has_a_seed_of_its_own() -> None:
    seeds = {seed_of(0, name, k) for name in ("Accident", "T_Junction") for k in (0, 1)}

    assert len(seeds) == 4
    assert seed_of(1, "Accident", 0) not in seeds


@pytest.mark.parametrize(
    ("expert", "blind", "again", "words"),
    [
        (FAILED, (FAILED,) * 3, None, "the expert commits: collisions_vehicle"),
        (LATE, (FAILED,) * 3, None, "ends after 75 s: blocked"),
        (replace(SOLVED, actors_crashed=True), (FAILED,) * 3, None, "two actors coll"),
        (SOLVED, (SOLVED, FAILED, FAILED), SOLVED, None),
        (None, (SOLVED, LATE), None, "no infraction at 8 and 12 m/s"),
        (SOLVED, (FAILED,) * 3, FAILED, "with other traffic the expert commits"),
        (SOLVED, (FAILED,) * 3, LATE, "with other traffic the expert ends after 75 s"),
        (UNMET, (replace(FAILED, triggered=False),) * 2, UNMET, "never happened"),
        (UNMET, (FAILED,) * 2, UNMET, None),
        (None, (replace(FAILED, actors_crashed=True),), None, "two actors collide"),
    ],
)
def test_why_a_route_is_admitted_or_refused(
    expert: DryRun | None,
    blind: tuple[DryRun, ...],
    again: DryRun | None,
    words: str | None,
) -> None:
    verdict = Admission(route_of(), expert, blind, again)

    assert verdict.admitted == (words is None)
    assert str(words) in str(verdict.refusal)


def test_the_gate_drives_as_little_as_it_must(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = list[tuple[str, object]]()
    outcomes = [SOLVED, FAILED, SOLVED, FAILED, FAILED, SOLVED, FAILED]

    def drive(route: Route, policy: object) -> DryRun:
        driven.append((type(policy).__name__, route.parameters.get("traffic")))
        assert getattr(policy, "cameras_only", True)
        return outcomes[len(driven) - 1]

    monkeypatch.setattr(room, "dry_run", drive)

    assert "blind" in str(examine(route_of()).refusal)
    assert "with other traffic" in str(examine(route_of()).refusal)
    assert [name for name, _ in driven] == ["Blind"] * 5 + ["Expert"] * 2
    assert driven[-1][1] != driven[-2][1]
