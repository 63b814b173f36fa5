"""The bicycle's circle, anchored plans, and tracking them with lag."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.driving.contract import PedalsAndWheel, Trajectory
from me2e_compress.evaluators.highway.controller import (
    AnchoredPlan,
    control_of,
    curvature_by,
)
from me2e_compress.simulator.bicycle import (
    MAX_STEERING_RAD,
    advance,
    curvature_of,
    slip_of,
    steering_through,
)
from me2e_compress.simulator.plane_geometry import RoutePath
from models.driver.expert.blind import centre_plan
from tests.evaluators.highway.tiny_world import (
    DT_US,
    TinyWorld,
    circle,
    ego_at,
    straight,
)
from tests.support.profiles import scaled

LENGTH_M = 5.0
AHEAD = np.array([[4.0 * k, 0.0] for k in range(1, 7)])


def follow(
    path: RoutePath,
    speed: float,
    seconds: float,
    *,
    every: int = 1,
    offset: float = 0.0,
) -> list[float]:
    """Drive the route's centre line at one speed; return all lateral offsets."""
    world = TinyWorld(path, ego_at(5.0, offset, speed=speed))
    offsets, s = list[float](), 5.0
    plan = AnchoredPlan.of(np.zeros((6, 2)), world.ego, 0)
    for frame in range(round(seconds * 1e6 / DT_US)):
        if frame % every == 0:
            s, _ = path.project(world.ego.x, world.ego.y, s)
            waypoints = centre_plan(world.ego, path, s, speed)
            plan = AnchoredPlan.of(waypoints, world.ego, world.time_us)
        world.step(plan.control(world.ego, world.time_us))
        offsets.append(path.project(world.ego.x, world.ego.y, s)[1])
    return offsets


@given(
    st.floats(-0.55, 0.55),
    st.floats(1.0, 6.0),
    st.floats(-3.0, 3.0),
    st.floats(-20.0, 20.0),
)
def test_the_steering_through_a_point_reaches_it(
    steering: float, travel: float, heading: float, place: float
) -> None:
    x, y, _ = advance(place, -place, heading, steering, travel, LENGTH_M)
    dx, dy = x - place, y + place
    forward = math.cos(heading) * dx + math.sin(heading) * dy
    left = math.cos(heading) * dy - math.sin(heading) * dx
    angle = steering_through(forward, left, LENGTH_M)
    assert angle == pytest.approx(steering, abs=2e-3)


@given(st.floats(0.1, 30.0), st.floats(-30.0, 30.0))
def test_any_target_gives_a_finite_angle_to_its_side(
    forward: float, left: float
) -> None:
    angle = steering_through(forward, left, LENGTH_M)
    assert abs(angle) <= MAX_STEERING_RAD
    assert angle * left >= 0


def test_the_circle_agrees_with_highway_env() -> None:
    """A thousand Euler steps of its kinematic bicycle, one of ours."""
    steering, speed, dt, x, y, heading = 0.3, 5.0, 1e-3, 0.0, 0.0, 0.0
    for _ in range(1000):
        slip = math.atan(math.tan(steering) / 2)
        x += speed * math.cos(heading + slip) * dt
        y += speed * math.sin(heading + slip) * dt
        heading += speed * math.sin(slip) / (LENGTH_M / 2) * dt
    ours = advance(0.0, 0.0, 0.0, steering, speed, LENGTH_M)
    assert ours == pytest.approx((x, y, heading), abs=2e-3)
    assert heading == pytest.approx(speed * curvature_of(steering, LENGTH_M), abs=1e-9)


def test_a_plan_is_anchored_where_it_was_made_and_goes_on() -> None:
    plan = AnchoredPlan.of(AHEAD, ego_at(10.0, -3.0, math.pi / 2), 0)
    assert plan.point(8.0) == pytest.approx((10.0, 5.0), abs=1e-6)
    np.testing.assert_allclose(plan.travel_m, 4.0 * np.arange(7))
    assert plan.nearest(10.4, 2.0) == pytest.approx(5.0, abs=1e-6)
    assert plan.travel_at(4.0) == pytest.approx(32.0)  # on at its last speed


def test_the_curve_leaves_on_the_course_not_on_the_heading() -> None:
    steering = 0.4
    waypoints = np.array([[4.0 * k, 1.2 * k * k] for k in range(1, 7)])
    plan = AnchoredPlan.of(waypoints, ego_at(0.0, 0.0, 0.0, 8.0, steering), 0)
    first = plan.curve[1] - plan.curve[0]
    assert math.atan2(first[1], first[0]) == pytest.approx(slip_of(steering), abs=0.05)


def test_a_heap_of_waypoints_is_a_stop() -> None:
    jitter = np.random.default_rng(3).normal(0.0, 0.03, (6, 2))
    ego = ego_at(speed=3.0)
    plan = AnchoredPlan.of(jitter, ego, 0)
    assert plan.travel_m[-1] < 0.3
    control = plan.control(ego, 0)
    assert control.acceleration_mps2 < -3.0
    assert abs(control.steering_rad) < 0.05


@pytest.mark.parametrize("every", [1, 5])
@pytest.mark.parametrize(("radius", "speed"), [(9.0, 4.0), (12.0, 5.0), (20.0, 6.5)])
def test_it_stays_on_a_ring(radius: float, speed: float, every: int) -> None:
    turn = 1.4 if radius < 10 else 4.5
    seconds = (25.0 + turn * radius) / speed
    offsets = follow(circle(radius, turn), speed, seconds, every=every)
    assert max(map(abs, offsets)) < 0.6
    assert abs(offsets[-1]) < 0.35


def test_it_returns_to_the_line_without_swinging() -> None:
    offsets = follow(straight(), 8.0, 6.0, offset=1.5)
    assert abs(offsets[-1]) < 0.02
    assert min(offsets) > -0.15


@given(st.floats(-7.0, 2.0))
@settings(max_examples=scaled(20))
def test_a_steady_acceleration_is_asked_for_exactly(rate: float) -> None:
    """Where nothing lags any more, the plan's acceleration comes out."""
    times, speed = 0.5 * np.arange(1, 7), 22.0
    travel = speed * times + rate * times**2 / 2
    waypoints = np.stack([travel, np.zeros(6)], axis=1)
    steady = replace(ego_at(speed=speed), acceleration_mps2=rate)
    control = AnchoredPlan.of(waypoints, steady, 0).control(steady, 0)
    assert control.acceleration_mps2 == pytest.approx(rate, abs=1e-6)


def test_an_old_plan_is_followed_from_where_it_has_got_to() -> None:
    """After 0.5 s on plan the same control is due as if it were planned anew."""
    plan = AnchoredPlan.of(AHEAD, ego_at(0.0), 0)
    control = plan.control(ego_at(4.0), 500_000)
    assert control.acceleration_mps2 == pytest.approx(0.0, abs=1e-6)
    late = plan.control(ego_at(2.0), 500_000)
    assert late.acceleration_mps2 > 2.0


@pytest.mark.parametrize(("count", "step_s"), [(30, 0.1), (10, 0.2), (4, 0.5)])
def test_the_same_way_in_other_waypoints_is_driven_the_same(
    count: int, step_s: float
) -> None:
    """A bend of 40 m at 6 m/s; how many points draw it is no matter."""
    ego = ego_at(speed=6.0)

    def planned(times: np.ndarray) -> Trajectory:
        turned = 6.0 * times / 40.0
        bend = 40.0 * np.stack([np.sin(turned), 1 - np.cos(turned)], axis=1)
        return Trajectory(bend, times)

    plans = planned(0.5 * np.arange(1, 7)), planned(step_s * np.arange(1, count + 1))
    six, other = (AnchoredPlan.of(plan, ego, 0).control(ego, 0) for plan in plans)
    assert other.steering_rad == pytest.approx(six.steering_rad, abs=5e-3)
    assert other.acceleration_mps2 == pytest.approx(six.acceleration_mps2, abs=0.1)


@pytest.mark.parametrize(
    ("throttle", "brake", "mps2"), [(0.5, 0.0, 2.0), (0.0, 1.0, -8.0), (1.0, 0.5, 0.0)]
)
def test_pedals_span_what_the_ego_can_do(
    throttle: float, brake: float, mps2: float
) -> None:
    result = control_of(PedalsAndWheel(throttle, 0.0, brake), LENGTH_M)

    assert result.acceleration_mps2 == pytest.approx(mps2)
    assert result.steering_rad == 0.0


@pytest.mark.parametrize("steer", [-0.4, 0.05, 0.3])
def test_a_steer_makes_the_same_circle(steer: float) -> None:
    angle = control_of(PedalsAndWheel(0.0, steer, 0.0), LENGTH_M).steering_rad

    assert curvature_of(angle, LENGTH_M) == pytest.approx(-curvature_by(steer))


def test_the_wheels_turn_no_further() -> None:
    assert curvature_by(1.0) == pytest.approx(1 / 3.72, rel=0.01)
    left = control_of(PedalsAndWheel(0.0, -1.0, 0.0), LENGTH_M)
    assert left.steering_rad == MAX_STEERING_RAD
