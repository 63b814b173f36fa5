import math
import subprocess
import sys

import pytest

from me2e_compress.base.errors import EvaluationError
from me2e_compress.metrics.episode import Ending
from me2e_compress.simulator.scenarios.roads import two_way
from me2e_compress.simulator.scene import ActorKind, Control, EventKind
from me2e_compress.simulator.traffic.bodies import Behaviour
from me2e_compress.simulator.traffic.stage import Script, Stage
from me2e_compress.simulator.world import World
from tests.simulator.world.driving import coast, empty_road, route_of, trace

DIGEST = """
import hashlib
from tests.simulator.world.driving import route_of, trace
seen = trace(route_of("EnterActorFlow", 7))
print(hashlib.sha256(repr(seen).encode()).hexdigest())
"""


def test_fresh_processes_see_the_same_bytes() -> None:
    command = [sys.executable, "-c", DIGEST]
    first, second = (
        subprocess.run(command, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    )

    assert len(first.strip()) == 64
    assert first == second


def test_what_ran_before_in_the_process_does_not_matter() -> None:
    alone = trace(route_of("HazardAtSideLane", 3))
    trace(route_of("YieldToEmergencyVehicle", 1))
    trace(route_of("T_Junction", 2), dt_us=20_000)

    assert trace(route_of("HazardAtSideLane", 3)) == alone


def test_a_given_parameter_changes_that_one_alone() -> None:
    drawn = World(route_of(seed=1)).parameters
    given = World(route_of(seed=1, obstacle_m=70.5)).parameters

    assert given == {**drawn, "obstacle_m": 70.5}


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_control_must_be_finite(value: float) -> None:
    world = World(route_of())

    with pytest.raises(EvaluationError, match="is not finite"):
        world.step(Control(0.0, value))


@pytest.mark.parametrize("dt_us", [0, 200_000])
def test_a_frame_must_fit_the_actors(dt_us: int) -> None:
    with pytest.raises(EvaluationError, match=f"frame of {dt_us} us"):
        World(route_of(), dt_us=dt_us)


def test_time_is_counted_in_whole_microseconds() -> None:
    world = World(route_of(), dt_us=10_000)
    coast(world, 7)

    assert world.time_us == 70_000
    assert world.scene().time_us == 70_000


def test_the_goal_ends_a_route() -> None:
    world = World(route_of(), builder=empty_road)
    coast(world, 600, Control(1.0, 0.0))

    assert world.reason is Ending.COMPLETED
    assert world.progress_m == world.path.goal_m > 200.0
    with pytest.raises(EvaluationError, match="has ended: completed"):
        world.step(Control(0.0, 0.0))


def test_a_collision_names_the_partner_and_ends_the_route() -> None:
    world = World(route_of("ParkedObstacleTwoWays", 0, obstacle="truck"))
    coast(world, 600)

    (event,) = [e for e in world.events if e.kind is EventKind.COLLISION]
    trucks = [a for a in world.scene().actors if a.kind is ActorKind.TRUCK]
    assert world.reason is Ending.COLLISION
    assert event.actor_kind is ActorKind.TRUCK
    assert event.actor_id == trucks[0].id
    assert event.ego_speed_mps > 5
    assert event.time_us == world.time_us


def test_two_actors_that_collide_are_told_from_the_ego() -> None:
    def rear_end(stage: Stage) -> None:
        street = two_way(stage)
        (lane,) = street.ahead(0)
        stage.add_car([lane], 150.0, 0.0).forced_mps2 = -1.0
        stage.add_car([lane], 135.0, 9.0).forced_mps2 = 0.0

    world = World(route_of(), builder=rear_end)
    coast(world, 60, Control(-8.0, 0.0))

    kinds = [event.kind for event in world.events]
    assert kinds == [EventKind.ACTOR_COLLISION]
    assert world.reason is None


@pytest.mark.parametrize(
    ("brake", "kinds"), [(-8.0, [EventKind.STRUCK]), (0.0, [EventKind.COLLISION])]
)
def test_a_standing_ego_that_is_struck_has_not_collided(
    brake: float, kinds: list[EventKind]
) -> None:
    def struck(stage: Stage) -> None:
        street = two_way(stage)
        (lane,) = street.ahead(0)
        blind = Behaviour(sees_ego=False)
        stage.add_car([lane], 20.0, 20.0, behaviour=blind).forced_mps2 = 0.0

    world = World(route_of(), builder=struck)
    coast(world, 120, Control(brake, 0.0))

    assert [event.kind for event in world.events] == kinds
    assert world.done is (EventKind.COLLISION in kinds)


def test_leaving_the_road_is_measured() -> None:
    world = World(route_of(), builder=empty_road)
    coast(world, 60, Control(0.0, -0.1))

    assert world.outside_m > 0.5
    assert world.outside_distance_m > 1.0
    assert [e.kind for e in world.events] == [EventKind.OUTSIDE_LANES]
    assert world.lateral_m < -2


def test_a_script_may_add_actors_while_it_runs() -> None:
    def late(stage: Stage) -> None:
        two_way(stage)
        stage.play_script(surprise(stage))

    def surprise(stage: Stage) -> Script:
        while stage.time_s < 0.5:
            yield
        stage.add_object(ActorKind.CONE, stage.route_pose(40.0))
        stage.record_trigger("surprise")

    world = World(route_of(), builder=late)
    assert world.scene().actors == ()
    coast(world, 15)

    (cone,) = world.scene().actors
    assert (cone.x, cone.y) == pytest.approx(tuple(world.path.points[40]))
    assert [e.kind for e in world.events] == [EventKind.TRIGGER]


def test_cars_that_leave_the_map_are_gone() -> None:
    def leaver(stage: Stage) -> None:
        street = two_way(stage)
        stage.add_car(
            street.ahead(0), stage.network.length(street.ahead()[0]) - 6.0, 10.0
        )

    world = World(route_of(), builder=leaver)
    assert len(world.scene().actors) == 1
    coast(world, 40)

    assert world.scene().actors == ()


def test_a_slick_patch_takes_grip_away() -> None:
    route = route_of("ControlLoss", 2)
    world = World(route)
    hardest = 0.0
    while not world.done and world.time_us < 20e6:
        slippery = any(e.kind is EventKind.TRIGGER for e in world.events)
        world.step(Control(-8.0 if slippery else 0.5, 0.0))
        if slippery:
            hardest = min(hardest, world.scene().ego.acceleration_mps2)
            if world.scene().ego.speed_mps == 0:
                break

    assert -4.0 <= hardest < -2.5


def test_running_a_red_light_does_not_end_a_route() -> None:
    world = World(route_of(offset_s=10.0), builder=empty_road)
    coast(world, 900)

    assert [event.kind for event in world.events] == [EventKind.RED_LIGHT]
    assert world.reason is Ending.COMPLETED
