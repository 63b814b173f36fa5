"""The expert on hand-made scenes, driven with lag through the controller."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.evaluators.highway.expert.expert_policy import (
    ExpertDecision,
    Memory,
    ceiling,
    decide,
)
from me2e_compress.simulator.scene import ActorKind, Scene, SignalKind, SignalState
from tests.evaluators.highway.tiny_world import (
    TinyWorld,
    actor,
    circle,
    drive,
    ego_at,
    signal_at,
    straight,
)
from tests.profiles import scaled

RED = SignalState.RED


def decide_in(world: TinyWorld, memory: Memory | None = None) -> ExpertDecision:
    known = world.privileged()
    top = ceiling(world.path)
    return decide(world.scene(), known, world.path, top, memory or Memory())


def offsets(world: TinyWorld, scenes: list[Scene]) -> list[float]:
    return [world.path.project(scene.ego.x, scene.ego.y)[1] for scene in scenes]


def test_an_empty_road_is_driven_at_its_limit() -> None:
    world = TinyWorld(straight(limit_mps=12.0), ego_at(speed=8.0))
    scenes = drive(world, 8.0)
    assert scenes[-1].ego.speed_mps == pytest.approx(12.0, abs=0.3)
    assert max(map(abs, offsets(world, scenes))) < 0.05


@pytest.mark.parametrize("speed", [5.0, 10.0])
def test_it_stops_behind_a_stopped_car(speed: float) -> None:
    world = TinyWorld(straight(), ego_at(speed=speed), (actor(60.0),))
    scenes = drive(world, 18.0)
    assert not world.touches
    assert scenes[-1].ego.speed_mps < 0.2
    assert 0.5 < 60.0 - 2.3 - (scenes[-1].ego.x + 2.5) < 6.0


def test_it_follows_a_slower_car_at_its_speed() -> None:
    world = TinyWorld(straight(), ego_at(speed=10.0), (actor(40.0, speed=5.0),))
    scenes = drive(world, 14.0)
    assert scenes[-1].ego.speed_mps == pytest.approx(5.0, abs=0.8)
    assert not world.touches


def test_it_overtakes_in_a_free_lane_beside() -> None:
    world = TinyWorld(
        straight(left_m=5.25), ego_at(speed=10.0), (actor(40.0, speed=3.0),)
    )
    scenes = drive(world, 10.0)
    assert not world.touches
    assert scenes[-1].ego.x > scenes[-1].actors[0].x + 10.0
    assert max(offsets(world, scenes)) > 2.5


def test_it_waits_for_oncoming_traffic_before_it_passes() -> None:
    parked = actor(60.0, kind=ActorKind.PARKED)
    oncoming = actor(130.0, 3.5, 8.0, math.pi, number=2)
    world = TinyWorld(straight(oncoming_m=5.25), ego_at(speed=10.0), (parked, oncoming))
    scenes = drive(world, 20.0)
    assert not world.touches
    assert scenes[-1].ego.x > 75.0
    beside = next(k for k, d in enumerate(offsets(world, scenes)) if d > 1.0)
    assert scenes[beside].actors[1].x < scenes[beside].ego.x + 8.0


def test_it_never_uses_an_oncoming_lane_without_need() -> None:
    world = TinyWorld(straight(oncoming_m=5.25), ego_at(speed=8.0))
    assert max(map(abs, offsets(world, drive(world, 6.0)))) < 0.1


def test_it_stops_at_a_red_light_and_starts_on_green() -> None:
    light = signal_at(60.0, SignalKind.TRAFFIC_LIGHT, RED)
    world = TinyWorld(straight(), ego_at(speed=10.0), (), (light,))
    red = drive(world, 14.0)
    assert red[-1].ego.speed_mps < 0.1
    assert 0.2 < 60.0 - (red[-1].ego.x + 2.5) < 2.5
    world.signals = (signal_at(60.0, SignalKind.TRAFFIC_LIGHT, SignalState.GREEN),)
    assert drive(world, 5.0)[-1].ego.x > 65.0


def test_a_yellow_light_that_cannot_be_obeyed_is_passed() -> None:
    light = signal_at(20.0, SignalKind.TRAFFIC_LIGHT, SignalState.YELLOW)
    near = TinyWorld(straight(), ego_at(x=10.0, speed=10.0), (), (light,))
    assert decide_in(near).acceleration_mps2 > -1.0
    far = TinyWorld(straight(), ego_at(x=-12.0, speed=8.0), (), (light,))
    assert decide_in(far).acceleration_mps2 < -0.3


def test_it_really_stops_at_a_stop_sign_and_then_goes_on() -> None:
    sign = signal_at(60.0, SignalKind.STOP_SIGN)
    world = TinyWorld(straight(), ego_at(speed=10.0), (), (sign,))
    scenes = drive(world, 18.0)
    stood = [s for s in scenes if s.ego.speed_mps < 0.1]
    assert stood
    assert 0.0 < 60.0 - (stood[0].ego.x + 2.5) < 4.0
    assert scenes[-1].ego.x > 65.0


def test_it_lets_a_crossing_car_pass() -> None:
    """At 8 m/s both would be at x = 45 after 5 s."""
    crossing = actor(45.0, -40.0, 8.0, math.pi / 2)
    world = TinyWorld(straight(limit_mps=8.0), ego_at(speed=8.0), (crossing,))
    scenes = drive(world, 12.0)
    assert not world.touches
    assert scenes[-1].ego.x > 60.0


def test_at_a_give_way_line_it_waits_before_the_line() -> None:
    sign = signal_at(40.0, SignalKind.GIVE_WAY)
    row = tuple(
        actor(48.0, -35.0 - 14.0 * k, 8.0, math.pi / 2, number=k + 1) for k in range(3)
    )
    world = TinyWorld(straight(), ego_at(speed=8.0), row, (sign,))
    for scene in drive(world, 15.0):
        front = scene.ego.x + 2.5
        due = [-a.y / 8.0 for a in scene.actors if a.y < 0]
        if abs(front - 40.0) < 0.3:
            assert min(due, default=9.0) > 1.5
    assert world.ego.x > 60.0


def test_it_brakes_for_a_pedestrian() -> None:
    walker = actor(45.0, -6.0, 1.4, math.pi / 2, ActorKind.PEDESTRIAN)
    world = TinyWorld(straight(), ego_at(speed=10.0), (walker,))
    scenes = drive(world, 12.0)
    assert not world.touches
    assert min(s.ego.speed_mps for s in scenes) < 8.0
    assert scenes[-1].ego.x > 60.0


def test_it_makes_way_for_an_emergency_vehicle() -> None:
    siren = actor(-30.0, 0.0, 12.0, kind=ActorKind.EMERGENCY)
    world = TinyWorld(straight(left_m=5.25), ego_at(speed=8.0), (siren,))
    scenes = drive(world, 9.0)
    assert not world.touches
    assert scenes[-1].actors[0].x > scenes[-1].ego.x


@pytest.mark.parametrize("radius", [12.0, 20.0])
def test_it_drives_round_a_ring(radius: float) -> None:
    world = TinyWorld(circle(radius, 4.5), ego_at(speed=6.0))
    scenes = drive(world, (20.0 + 4.5 * radius) / 7.0, every=2)
    assert max(map(abs, offsets(world, scenes))) < 0.6
    fastest = max(s.ego.speed_mps for s in scenes[-20:])
    assert fastest**2 / radius < 3.0


@given(
    st.floats(-3.0, 3.0),
    st.floats(-0.9, 0.9),
    st.floats(0.0, 14.0),
    st.floats(-0.5, 0.5),
)
@settings(max_examples=scaled(40))
def test_it_plans_from_any_state(
    y: float, heading: float, speed: float, steering: float
) -> None:
    ego = ego_at(20.0, y, heading, speed, steering)
    cars = (actor(55.0), actor(80.0, 3.5, 6.0, math.pi, number=2))
    plan = decide_in(TinyWorld(straight(oncoming_m=5.25), ego, cars)).waypoints
    assert plan.shape == (6, 2)
    assert np.isfinite(plan).all()
    steps = np.hypot(*np.diff(np.vstack([np.zeros((1, 2)), plan]), axis=0).T)
    assert steps.max() < 0.5 * max(speed, 13.0) * 1.3 + 0.3


@pytest.mark.parametrize(("y", "heading"), [(2.0, 0.3), (-2.0, -0.4), (3.0, 0.0)])
def test_it_returns_from_off_the_route(y: float, heading: float) -> None:
    world = TinyWorld(straight(), ego_at(20.0, y, heading))
    assert abs(offsets(world, drive(world, 6.0))[-1]) < 0.2


def test_the_same_question_has_the_same_answer() -> None:
    world = TinyWorld(straight(left_m=5.25), ego_at(), (actor(40.0, speed=3.0),))
    first, second = decide_in(world), decide_in(world)
    assert first.waypoints.tobytes() == second.waypoints.tobytes()
    assert first.memory == second.memory


def test_it_keeps_the_lane_that_it_has_chosen() -> None:
    world = TinyWorld(straight(left_m=5.25), ego_at(), (actor(60.0, speed=4.0),))
    chosen = decide_in(world, Memory(target_m=3.5))
    assert chosen.target_m > 2.0
