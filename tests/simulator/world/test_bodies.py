import itertools
import math

import numpy as np
import pytest
from highway_env.utils import are_polygons_intersecting
from highway_env.vehicle.behavior import IDMVehicle
from hypothesis import assume, given
from hypothesis import strategies as st

from me2e_compress.simulator.plane_geometry import overlaps
from me2e_compress.simulator.scene import ActorKind, Control
from me2e_compress.simulator.traffic.bodies import (
    DRY_GRIP_MPS2,
    Behaviour,
    Car,
    EgoVehicle,
    StaticObject,
    Walker,
)
from me2e_compress.simulator.traffic.network import (
    LaneTable,
    Network,
    Pose,
    Section,
    flip,
)
from me2e_compress.simulator.traffic.right_of_way import RightOfWay
from me2e_compress.simulator.traffic.traffic_road import TrafficRoad


def driven(control: Control, seconds: float, dt: float, speed: float) -> EgoVehicle:
    ego = EgoVehicle(Pose(0.0, 0.0, 0.3), speed)
    ego.wanted = control
    for _ in range(round(seconds / dt)):
        ego.step(dt)
    return ego


def test_the_ego_brakes_with_a_lag_to_rest_and_never_reverses() -> None:
    ego = driven(Control(-8.0, 0.0), 4.0, 0.05, 10.0)
    begun = driven(Control(3.0, 0.0), 0.2, 0.05, 5.0)

    assert ego.speed == 0
    assert ego.pose.x > 0
    assert begun.snapshot().acceleration_mps2 == pytest.approx(3 * (1 - math.exp(-1)))


def test_a_positive_wheel_angle_turns_left() -> None:
    ego = driven(Control(0.0, 0.3), 1.0, 0.05, 5.0).snapshot()

    assert ego.heading > 0.3
    assert ego.yaw_rate_radps > 0
    assert ego.lateral_acceleration_mps2 > 0


@given(st.floats(-0.5, 0.5), st.floats(-4.0, 3.0), st.floats(2.0, 9.0))
def test_a_finer_step_hardly_changes_a_held_control(
    wheel: float, push: float, speed: float
) -> None:
    coarse = driven(Control(push, wheel), 2.0, 0.05, speed).pose
    fine = driven(Control(push, wheel), 2.0, 0.01, speed).pose

    assert math.hypot(coarse.x - fine.x, coarse.y - fine.y) < 0.6


@given(st.floats(5.0, 20.0), st.floats(0.2, 0.6))
def test_tyres_hold_no_more_than_their_grip(speed: float, wheel: float) -> None:
    ego = driven(Control(0.0, wheel), 1.0, 0.05, speed).snapshot()

    assert abs(ego.lateral_acceleration_mps2) <= DRY_GRIP_MPS2 * 1.001


def road_on(network: Network) -> TrafficRoad:
    return TrafficRoad(network, RightOfWay(network, {}, []))


def one_lane(length: float = 300.0) -> tuple[Network, TrafficRoad]:
    network = Network()
    network.straight("a", "b", Pose(0.0, 0.0, 0.0), length, Section(limit_mps=20.0))
    return network, road_on(network)


def put(road: TrafficRoad, *cars: Car | StaticObject) -> None:
    for car in cars:
        car.road = road
    road.vehicles = [car for car in cars if isinstance(car, Car)]
    road.objects = [car for car in cars if isinstance(car, StaticObject)]


def run(road: TrafficRoad, seconds: float) -> None:
    for frame in range(round(seconds * 20)):
        if frame % 2 == 0:
            road.act()
        road.step(0.05)
        assert all(car.speed >= 0 for car in road.vehicles)


@given(st.floats(3.0, 40.0), st.floats(0.0, 15.0), st.floats(0.0, 15.0))
def test_a_follower_never_reverses_nor_hits_a_leader_with_room(
    gap: float, speed: float, lead: float
) -> None:
    assume(speed - lead < math.sqrt(2 * 4.0 * gap))
    network, road = one_lane()
    chain = [("a", "b", 0)]
    front = Car(1, network, chain, 60.0, lead)
    rear = Car(2, network, chain, 60.0 - 4.6 - gap, speed, 12.0)
    put(road, rear, front)

    run(road, 8.0)

    assert road.touching() == []
    assert rear.lane_s < front.lane_s


def bent(pose: Pose, radius: float, angle: float, lanes: int = 2) -> Network:
    network, section = Network(), Section(lanes)
    pose = network.straight("a", "b", pose, 40.0, section)
    pose = network.arc("b", "c", pose, radius, angle, section)
    network.straight("c", "d", pose, 60.0, section)
    return network


BENT = [("a", "b", 0), ("b", "c", 0), ("c", "d", 0)]


def test_a_car_stops_behind_what_stands_around_the_corner() -> None:
    network = bent(Pose(0.0, 0.0, 0.0), 15.0, math.pi / 2, 1)
    road, car = road_on(network), Car(1, network, BENT, 5.0, 8.0)
    parked = StaticObject(2, ActorKind.PARKED, network.pose(("c", "d", 0), 8.0))
    put(road, car, parked)

    run(road, 20.0)

    assert car.speed < 0.5
    assert car.leg == 2
    assert not overlaps(np.array(car.box), np.array(parked.box))


def test_a_car_keeps_to_its_lane_through_a_bend() -> None:
    network = bent(Pose(0.0, 0.0, 1.0), 12.0, -math.pi / 2, 1)
    road, car = road_on(network), Car(1, network, BENT, 5.0, 8.0)
    put(road, car)

    for _ in range(60):
        run(road, 0.1)
        lane = network.lane(car.lanes[car.leg])
        assert abs(lane.local_coordinates(car.position)[1]) < 0.8


def test_manners_belong_to_one_car_and_leave_the_class_alone() -> None:
    network, _ = one_lane()
    before = {name: getattr(IDMVehicle, name) for name in ("TIME_WANTED", "DELTA")}

    mind = Behaviour(headway_s=0.3)
    pushy = Car(1, network, [("a", "b", 0)], 5.0, 8.0, behaviour=mind)
    polite = Car(2, network, [("a", "b", 0)], 30.0, 8.0)

    assert pushy.TIME_WANTED == 0.3
    assert Behaviour().headway_s == polite.TIME_WANTED
    assert {name: getattr(IDMVehicle, name) for name in before} == before


def test_two_cars_do_not_share_their_chain_of_lanes() -> None:
    network, _ = one_lane()
    chain = [("a", "b", 0)]
    first, second = (Car(i, network, chain, 9.0 * i, 0.0) for i in (1, 2))

    first.change_lane([("a", "b", 0), ("a", "b", 0)], 0)

    assert second.lanes == chain == [("a", "b", 0)]


def test_a_walker_waits_then_walks_its_line() -> None:
    line = np.array([[0.0, 0.0], [0.0, 4.0], [3.0, 4.0]])
    walker = Walker(1, ActorKind.PEDESTRIAN, line, 1.5)
    walker.step(0.05)
    assert walker.speed == 0

    walker.going = True
    for _ in range(200):
        walker.step(0.05)

    assert walker.done
    assert walker.speed == 0
    assert tuple(walker.position) == pytest.approx((3.0, -4.0))


boxes = st.tuples(st.floats(-6.0, 6.0), st.floats(-6.0, 6.0), st.floats(-4.0, 4.0))


@given(boxes, boxes)
def test_overlap_agrees_with_highway_env(
    one: tuple[float, float, float], other: tuple[float, float, float]
) -> None:
    a = StaticObject(1, ActorKind.PARKED, Pose(*one))
    b = StaticObject(2, ActorKind.VAN, Pose(*other))
    still = np.zeros(2)

    expected, _, _ = are_polygons_intersecting(a.polygon(), b.polygon(), still, still)

    assert overlaps(np.array(a.box), np.array(b.box)) == expected


angles = st.floats(-3.0, 3.0)
places = st.floats(-50.0, 50.0)


@given(places, places, angles, st.floats(10.0, 60.0), st.sampled_from([-1.2, 0.9]))
def test_pieces_join_without_a_kink(
    x: float, y: float, heading: float, radius: float, angle: float
) -> None:
    network = bent(Pose(x, y, heading), radius, angle)

    for lane, (first, second) in itertools.product((0, 1), itertools.pairwise(BENT)):
        here, there = (*first[:2], lane), (*second[:2], lane)
        end, begin = network.pose(here, network.length(here)), network.pose(there, 0.0)

        assert math.hypot(end.x - begin.x, end.y - begin.y) < 1e-6
        turn = math.remainder(end.heading - begin.heading, math.tau)
        assert turn == pytest.approx(0, abs=1e-6)


@given(angles, st.floats(10.0, 60.0))
def test_a_positive_angle_turns_left(heading: float, radius: float) -> None:
    network = Network()
    start = Pose(0.0, 0.0, heading)
    end = network.arc("a", "b", start, radius, math.pi / 2, Section())

    middle = network.pose(("a", "b", 0), network.length(("a", "b", 0)))

    assert (middle.x, middle.y) == pytest.approx((end.x, end.y), abs=1e-6)
    left = start.moved(radius, radius)
    assert (end.x, end.y) == pytest.approx((left.x, left.y), abs=1e-6)


def test_lanes_lie_to_the_right_and_the_rest_of_a_chain_begins_at_its_length() -> None:
    network, chain = bent(Pose(0.0, 0.0, 0.0), 30.0, 0.9), BENT

    assert network.pose(("a", "b", 1), 10.0).y == pytest.approx(-3.5)
    assert network.length(("b", "c", 1)) == pytest.approx(33.5 * 0.9)
    assert network.rest(chain, 39.0) == (chain, 39.0)
    lanes, s_m = network.rest(chain, 45.0)
    assert lanes == chain[1:]
    assert s_m == pytest.approx(5.0)
    assert network.rest(chain[2:], 99.0) == (chain[2:], 99.0)


@given(st.lists(st.tuples(places, places), min_size=1, max_size=8))
def test_the_table_agrees_with_highway_env(points: list[tuple[float, float]]) -> None:
    network = bent(Pose(-20.0, 5.0, 0.4), 25.0, -1.2)
    table = LaneTable(network.graph)
    flipped = np.array([flip(x, y) for x, y in points])

    s, r = table.coordinates(flipped)

    for index, column in table.column.items():
        lane = network.lane(index)
        asked = np.array([lane.local_coordinates(point) for point in flipped])
        np.testing.assert_allclose(s[:, column], asked[:, 0], atol=1e-9)
        np.testing.assert_allclose(r[:, column], asked[:, 1], atol=1e-9)
        headings = np.array([lane.heading_at(value) for value in s[:, column]])
        np.testing.assert_allclose(table.headings(s)[:, column], headings, atol=1e-9)
