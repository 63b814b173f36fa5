"""Forecasts, speed ceilings and gaps, one at a time."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.simulator.plane_geometry import RoutePath
from me2e_compress.simulator.scene import (
    Actor,
    ActorKind,
    Scene,
    SignalKind,
    SignalState,
)
from models.driver.expert.expert_policy import (
    LATERAL_MPS2,
    ExpertDecision,
    Memory,
    ceiling,
    decide,
    must_give_way,
)
from models.driver.expert.forecast import NOW_S, Forecast, forecast
from models.driver.expert.futures import (
    BESIDE_M,
    Options,
    Place,
    blocked_stretch,
    headway_cost,
    lateral_targets,
    sample,
)
from models.driver.expert.privileged import Intent
from models.tests.driver.known_world import KnownWorld, drive, signal_at
from tests.evaluators.highway.tiny_world import (
    actor,
    circle,
    ego_at,
    straight,
)
from tests.support.profiles import scaled


def look(path: RoutePath, *actors: Actor, intents: tuple[Intent, ...] = ()) -> Forecast:
    scene = Scene(0, ego_at(), actors, ())
    return forecast(scene, {i.actor_id: i for i in intents}, path, 5.0)


def place(speed: float = 8.0, lateral: float = 0.0) -> Place:
    return Place(5.0, lateral, 0.0, speed, 0.0, 12.0)


def test_without_an_intent_an_actor_keeps_course_and_speed() -> None:
    seen = look(straight(), actor(20.0, 3.0, 4.0, math.pi))
    np.testing.assert_allclose(seen.x[0], 20.0 - 4.0 * NOW_S)
    np.testing.assert_allclose(seen.y[0], 3.0, atol=1e-9)
    assert not seen.yields[0]


def test_an_intent_is_followed_around_the_corner() -> None:
    corner = np.array([[20.0, 0.0], [40.0, 0.0], [40.0, 40.0]])
    intent = Intent(1, corner, 8.0, 0.0, True)
    seen = look(straight(), actor(20.0, speed=8.0), intents=(intent,))
    assert (seen.x[0, -1], seen.y[0, -1]) == pytest.approx((40.0, 28.0))
    assert seen.heading[0, -1] == pytest.approx(math.pi / 2)
    assert seen.yields[0]


def test_a_heading_passes_half_a_turn_the_short_way() -> None:
    turned = np.array([3.0, 3.1, 3.2, 3.3])
    steps = 10.0 * np.stack([np.cos(turned), np.sin(turned)], axis=1)
    line = np.array([60.0, 0.0]) + np.cumsum(np.vstack([[0.0, 0.0], steps]), axis=0)
    intent = Intent(1, line, 8.0, 0.0, True)
    seen = look(straight(), actor(60.0, 0.0, 8.0, 3.0), intents=(intent,))
    assert seen.heading[0].min() >= 3.0 - 1e-9
    assert seen.heading[0].max() <= 3.3 + 1e-9


def test_a_braking_actor_stops_and_stays() -> None:
    line = np.array([[20.0, 0.0], [90.0, 0.0]])
    intent = Intent(1, line, 0.0, -4.0, True)
    seen = look(straight(), actor(20.0, speed=8.0), intents=(intent,))
    assert seen.x[0, -1] == pytest.approx(28.0, abs=0.6)
    assert seen.speed_mps[0, -1] == 0.0


def test_who_crawls_in_a_queue_is_not_expected_to_leap() -> None:
    line = np.array([[20.0, 0.0], [150.0, 0.0]])
    intent = Intent(1, line, 9.0, 0.1, True)
    seen = look(straight(), actor(20.0, speed=2.0), intents=(intent,))
    assert seen.speed_mps[0, -1] < 4.5


def test_a_walker_sets_off_at_once() -> None:
    line = np.array([[40.0, -6.0], [40.0, 6.0]])
    intent = Intent(1, line, 1.5, 0.0, False)
    walker = actor(40.0, -6.0, 0.0, math.pi / 2, ActorKind.PEDESTRIAN)
    seen = look(straight(), walker, intents=(intent,))
    assert seen.y[0, 4] == pytest.approx(-6.0 + 1.5 * 1.0, abs=0.4)


def test_the_route_frame_has_left_positive() -> None:
    seen = look(circle(20.0, 2.0), actor(15.0, 2.5))
    assert seen.along_m[0, 0] == pytest.approx(15.0, abs=1e-3)
    assert seen.lateral_m[0, 0] == pytest.approx(2.5, abs=1e-3)


def test_the_ceiling_is_low_in_the_bend_and_reached_by_easy_braking() -> None:
    top = ceiling(circle(20.0, 2.0, run_in_m=60.0))
    assert top[75] == pytest.approx(math.sqrt(LATERAL_MPS2 * 20.0), rel=0.05)
    assert top[10] == 12.0
    assert (np.diff(top**2) / 2 > -1.81).all()


@pytest.mark.parametrize("aside_m", [-0.05, 0.05])
def test_who_is_passed_with_too_little_room_is_a_leader(aside_m: float) -> None:
    path, ego = straight(), ego_at()
    leader = actor(20.0, 0.0, 8.0)
    reach_m = leader.width / 2 + ego.width / 2 + BESIDE_M
    seen = look(path, actor(20.0, reach_m + aside_m, 8.0))
    kept = Options(np.zeros(1), np.zeros(1, bool), False)
    future = sample(path, ceiling(path), ego, place(), kept, None)
    paid = headway_cost(future, seen, ego, place(), False)
    assert (paid > 0).any() == (aside_m < 0)


def test_neighbours_in_a_row_are_one_block() -> None:
    row = (actor(40.0), actor(50.0, number=2), actor(90.0, number=3))
    block = blocked_stretch(place(), ego_at(), look(straight(), *row))
    assert block is not None
    assert block.start_m == pytest.approx(40.0 - 2.3 - 5.0)
    assert block.end_m == pytest.approx(50.0 + 2.3 - 5.0)


@pytest.mark.parametrize(
    "other",
    [
        actor(40.0, speed=6.0),
        actor(40.0, 3.5),
        actor(40.0, -2.0, 1.4, math.pi / 2, ActorKind.PEDESTRIAN),
    ],
    ids=["drives", "beside", "walks"],
)
def test_what_moves_or_stands_aside_blocks_nothing(other: Actor) -> None:
    assert blocked_stretch(place(), ego_at(), look(straight(), other)) is None


def test_the_oncoming_lane_is_offered_only_with_a_gap() -> None:
    path = straight(oncoming_m=5.25)
    parked = actor(30.0, kind=ActorKind.PARKED)
    free = lateral_targets(path, place(), ego_at(), look(path, parked))
    assert free.oncoming.any()
    near = actor(75.0, 3.5, 8.0, math.pi, number=2)
    shut = lateral_targets(path, place(), ego_at(), look(path, parked, near))
    assert not shut.oncoming.any()
    inside = lateral_targets(path, place(lateral=3.0), ego_at(), look(path, near))
    assert inside.oncoming.any()


def test_targets_stay_on_the_road() -> None:
    path = straight(left_m=5.25, right_m=1.75)
    options = lateral_targets(path, place(), ego_at(), look(path))
    assert options.target_m[0] == 0.0
    assert options.target_m.max() <= 5.25 - 1.0
    assert options.target_m.min() >= -1.75 + 1.0


def test_who_crosses_soon_has_priority_and_who_leads_has_not() -> None:
    path = straight()
    crossing = look(path, actor(45.0, -16.0, 8.0, math.pi / 2))
    assert must_give_way(crossing, 40.0, 1.0)
    assert not must_give_way(crossing, 40.0, 4.5)
    assert not must_give_way(look(path, actor(45.0, 0.0, 8.0)), 40.0, 1.0)


# The expert on hand-made scenes, driven with lag through the controller.


RED = SignalState.RED


def decide_in(world: KnownWorld, memory: Memory | None = None) -> ExpertDecision:
    known = world.privileged()
    top = ceiling(world.path)
    return decide(world.scene(), known, world.path, top, memory or Memory())


def offsets(world: KnownWorld, scenes: list[Scene]) -> list[float]:
    return [world.path.project(scene.ego.x, scene.ego.y)[1] for scene in scenes]


def test_an_empty_road_is_driven_at_its_limit() -> None:
    world = KnownWorld(straight(limit_mps=12.0), ego_at(speed=8.0))
    scenes = drive(world, 8.0)
    assert scenes[-1].ego.speed_mps == pytest.approx(12.0, abs=0.3)
    assert max(map(abs, offsets(world, scenes))) < 0.05


@pytest.mark.parametrize("speed", [5.0, 10.0])
def test_it_stops_behind_a_stopped_car(speed: float) -> None:
    world = KnownWorld(straight(), ego_at(speed=speed), (actor(60.0),))
    scenes = drive(world, 18.0)
    assert not world.touches
    assert scenes[-1].ego.speed_mps < 0.2
    assert 0.5 < 60.0 - 2.3 - (scenes[-1].ego.x + 2.5) < 6.0


def test_it_follows_a_slower_car_at_its_speed() -> None:
    world = KnownWorld(straight(), ego_at(speed=10.0), (actor(40.0, speed=5.0),))
    scenes = drive(world, 14.0)
    assert scenes[-1].ego.speed_mps == pytest.approx(5.0, abs=0.8)
    assert not world.touches


def test_it_overtakes_in_a_free_lane_beside() -> None:
    world = KnownWorld(
        straight(left_m=5.25), ego_at(speed=10.0), (actor(40.0, speed=3.0),)
    )
    scenes = drive(world, 10.0)
    assert not world.touches
    assert scenes[-1].ego.x > scenes[-1].actors[0].x + 10.0
    assert max(offsets(world, scenes)) > 2.5


def test_it_waits_for_oncoming_traffic_before_it_passes() -> None:
    parked = actor(60.0, kind=ActorKind.PARKED)
    oncoming = actor(130.0, 3.5, 8.0, math.pi, number=2)
    world = KnownWorld(
        straight(oncoming_m=5.25), ego_at(speed=10.0), (parked, oncoming)
    )
    scenes = drive(world, 20.0)
    assert not world.touches
    assert scenes[-1].ego.x > 75.0
    beside = next(k for k, d in enumerate(offsets(world, scenes)) if d > 1.0)
    assert scenes[beside].actors[1].x < scenes[beside].ego.x + 8.0


def test_it_never_uses_an_oncoming_lane_without_need() -> None:
    world = KnownWorld(straight(oncoming_m=5.25), ego_at(speed=8.0))
    assert max(map(abs, offsets(world, drive(world, 6.0)))) < 0.1


def test_it_stops_at_a_red_light_and_starts_on_green() -> None:
    light = signal_at(60.0, SignalKind.TRAFFIC_LIGHT, RED)
    world = KnownWorld(straight(), ego_at(speed=10.0), (), (light,))
    red = drive(world, 14.0)
    assert red[-1].ego.speed_mps < 0.1
    assert 0.2 < 60.0 - (red[-1].ego.x + 2.5) < 2.5
    world.signals = (signal_at(60.0, SignalKind.TRAFFIC_LIGHT, SignalState.GREEN),)
    assert drive(world, 5.0)[-1].ego.x > 65.0


def test_a_yellow_light_that_cannot_be_obeyed_is_passed() -> None:
    light = signal_at(20.0, SignalKind.TRAFFIC_LIGHT, SignalState.YELLOW)
    near = KnownWorld(straight(), ego_at(x=10.0, speed=10.0), (), (light,))
    assert decide_in(near).acceleration_mps2 > -1.0
    far = KnownWorld(straight(), ego_at(x=-12.0, speed=8.0), (), (light,))
    assert decide_in(far).acceleration_mps2 < -0.3


def test_it_really_stops_at_a_stop_sign_and_then_goes_on() -> None:
    sign = signal_at(60.0, SignalKind.STOP_SIGN)
    world = KnownWorld(straight(), ego_at(speed=10.0), (), (sign,))
    scenes = drive(world, 18.0)
    stood = [s for s in scenes if s.ego.speed_mps < 0.1]
    assert stood
    assert 0.0 < 60.0 - (stood[0].ego.x + 2.5) < 4.0
    assert scenes[-1].ego.x > 65.0


def test_it_lets_a_crossing_car_pass() -> None:
    """At 8 m/s both would be at x = 45 after 5 s."""
    crossing = actor(45.0, -40.0, 8.0, math.pi / 2)
    world = KnownWorld(straight(limit_mps=8.0), ego_at(speed=8.0), (crossing,))
    scenes = drive(world, 12.0)
    assert not world.touches
    assert scenes[-1].ego.x > 60.0


def test_at_a_give_way_line_it_waits_before_the_line() -> None:
    sign = signal_at(40.0, SignalKind.GIVE_WAY)
    row = tuple(
        actor(48.0, -35.0 - 14.0 * k, 8.0, math.pi / 2, number=k + 1) for k in range(3)
    )
    world = KnownWorld(straight(), ego_at(speed=8.0), row, (sign,))
    for scene in drive(world, 15.0):
        front = scene.ego.x + 2.5
        due = [-a.y / 8.0 for a in scene.actors if a.y < 0]
        if abs(front - 40.0) < 0.3:
            assert min(due, default=9.0) > 1.5
    assert world.ego.x > 60.0


def test_it_brakes_for_a_pedestrian() -> None:
    walker = actor(45.0, -6.0, 1.4, math.pi / 2, ActorKind.PEDESTRIAN)
    world = KnownWorld(straight(), ego_at(speed=10.0), (walker,))
    scenes = drive(world, 12.0)
    assert not world.touches
    assert min(s.ego.speed_mps for s in scenes) < 8.0
    assert scenes[-1].ego.x > 60.0


def test_it_makes_way_for_an_emergency_vehicle() -> None:
    siren = actor(-30.0, 0.0, 12.0, kind=ActorKind.EMERGENCY)
    world = KnownWorld(straight(left_m=5.25), ego_at(speed=8.0), (siren,))
    scenes = drive(world, 9.0)
    assert not world.touches
    assert scenes[-1].actors[0].x > scenes[-1].ego.x


@pytest.mark.parametrize("radius", [12.0, 20.0])
def test_it_drives_round_a_ring(radius: float) -> None:
    world = KnownWorld(circle(radius, 4.5), ego_at(speed=6.0))
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
    plan = decide_in(KnownWorld(straight(oncoming_m=5.25), ego, cars)).waypoints
    assert plan.shape == (6, 2)
    assert np.isfinite(plan).all()
    steps = np.hypot(*np.diff(np.vstack([np.zeros((1, 2)), plan]), axis=0).T)
    assert steps.max() < 0.5 * max(speed, 13.0) * 1.3 + 0.3


@pytest.mark.parametrize(("y", "heading"), [(2.0, 0.3), (-2.0, -0.4), (3.0, 0.0)])
def test_it_returns_from_off_the_route(y: float, heading: float) -> None:
    world = KnownWorld(straight(), ego_at(20.0, y, heading))
    assert abs(offsets(world, drive(world, 6.0))[-1]) < 0.2


def test_it_keeps_the_lane_that_it_has_chosen() -> None:
    world = KnownWorld(straight(left_m=5.25), ego_at(), (actor(60.0, speed=4.0),))
    chosen = decide_in(world, Memory(target_m=3.5))
    assert chosen.target_m > 2.0
