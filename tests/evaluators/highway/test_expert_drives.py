"""The expert, through the controller, on the real world."""

import numpy as np
import pytest

from me2e_compress.driving.realtime import HeldControl
from me2e_compress.evaluators import Drive
from me2e_compress.evaluators.highway.controller import AnchoredPlan
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.evaluators.highway.expert.expert_policy import (
    Expert,
    Memory,
    ceiling,
    decide,
)
from me2e_compress.evaluators.highway.generate import dry_run
from me2e_compress.evaluators.highway.runner import drive
from me2e_compress.metrics.episode import Ending
from me2e_compress.metrics.route_scores import route_score
from me2e_compress.shipped.drivers import shipped
from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.routes import (
    SCENARIO_ABILITIES,
    Route,
    load_routes,
    pick_routes,
)
from me2e_compress.simulator.scene import INFRACTIONS, Control
from me2e_compress.simulator.world import World

SEED = 77_001


def route(scenario: str, seed: int = SEED) -> Route:
    return Route(f"{scenario}-{seed}", scenario, SCENARIO_ABILITIES[scenario][0], seed)


@pytest.mark.parametrize(
    "scenario",
    [
        "AccidentTwoWays",
        "EnterActorFlow",
        "PedestrianCrossing",
        "SequentialLaneChange",
        "VanillaNonSignalizedTurnEncounterStopsign",
        "VanillaSignalizedTurnEncounterRedLight",
        "YieldToEmergencyVehicle",
    ],
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
        decision = decide(scene, world.privileged(), world.path, top, memory)
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
    held = HeldControl(Control(0.0, 0.0))
    world, memory = World(route("EnterActorFlow")), Memory()
    top = ceiling(world.path)
    while not world.done and world.time_us < 40_000_000:
        if held.decision_is_due:
            scene = world.scene()
            decision = decide(scene, world.privileged(), world.path, top, memory)
            memory = decision.memory
            plan = AnchoredPlan.of(decision.waypoints, scene.ego, scene.time_us)
            control = plan.control(scene.ego, scene.time_us)
            held.decide(control, 850_000)
        world.step(held.advance())
    wrong = [event.kind for event in world.events if event.kind in INFRACTIONS]
    assert wrong or not world.done


# The weights that ship, in closed loop; five CPU seconds.


def test_the_shipped_driver_passes_a_parked_car() -> None:
    """A route that nobody passes blindly, and one of the shortest."""
    (route,) = pick_routes(load_routes(), "ParkedObstacle_R2_0")
    policy = OnnxDriver(shipped("highway")).open()

    episode = drive(route, policy, Drive())

    assert (episode.ending, episode.infractions) == (Ending.COMPLETED, ())
    assert route_score(episode).composed == 100.0
