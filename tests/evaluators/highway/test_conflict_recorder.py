"""Distance, time to collision, encounters and fault, on scenes made by hand."""

import math
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.evaluators.highway.episode_recorder import (
    EpisodeRecorder,
    at_fault,
    conflicts_of,
    contact_of,
    junction_m,
)
from me2e_compress.metrics.episode import ConflictRecord, Contact, Ending
from me2e_compress.simulator.plane_geometry import (
    Command,
    Lane,
    LaneMarking,
    Roadmap,
    RoutePath,
    contact_times,
    corners,
    gaps,
    overlaps,
)
from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.scene import Actor, ActorKind, Ego, Event, EventKind, Scene
from me2e_compress.simulator.world import World
from tests.evaluators.highway.tiny_world import actor, ego_at, straight

LEFT = math.pi / 2
FRAMES_A_SECOND = 20


def lane(name: str, begin: float, end: float, y: float = 0.0) -> Lane:
    points = np.array([[begin, y], [end, y]])
    return Lane(name, points, 3.5, LaneMarking.DASHED, LaneMarking.DASHED)


ROAD = Roadmap((lane("a>b:0", -20.0, 6.0), lane("b>c:0", 6.0, 60.0)))


def recorded(*frames: tuple[Ego, tuple[Actor, ...]]) -> ConflictRecord:
    scenes = [Scene(50_000 * k, *frame, ()) for k, frame in enumerate(frames)]
    return conflicts_of(scenes)


def crossing(late_s: float) -> ConflictRecord:
    """Drive on at 8 m/s along x = 0; an actor of 4.6 m crosses at 5 m/s, from below."""
    frames = []
    for t in np.arange(8 * FRAMES_A_SECOND) / FRAMES_A_SECOND:
        other = actor(0.0, 5.0 * (t - late_s) - 15.0, 5.0, LEFT)
        frames.append((ego_at(8.0 * t - 24.0), (other,)))
    return recorded(*frames)


@pytest.mark.parametrize(
    ("ego", "others", "nearest_m", "ttc_s"),
    [
        # outlines 20 m apart, closing at 8 m/s
        (ego_at(0.0), (actor(20.0 + 2.5 + 2.3),), 20.0, 2.5),
        (ego_at(0.0), (actor(30.0, speed=9.0),), 25.2, None),  # it drives away
        (ego_at(0.0, speed=1.0), (actor(11.0 + 4.8),), 11.0, None),  # in 11 s
        (ego_at(0.4), (), None, None),
    ],
)
def test_how_near_others_are_and_when_they_are_met(
    ego: Ego, others: tuple[Actor, ...], nearest_m: float | None, ttc_s: float | None
) -> None:
    result = recorded((ego, others))

    (nearest,) = result.nearest_m
    assert nearest == pytest.approx(nearest_m)
    assert result.ttc_s == (ttc_s,)


@pytest.mark.parametrize(("late_s", "ego_first"), [(2.5, True), (-2.5, False)])
def test_paths_that_cross_one_after_the_other(late_s: float, ego_first: bool) -> None:
    (result,) = crossing(late_s).encounters

    # The ego (5 m, 8 m/s) covers the actor's 1.95 m path for (5 + 1.95) / 8 s, the
    # actor (4.6 m, 5 m/s) the ego's 2 m path for (4.6 + 2) / 5 s; both are in its
    # middle after 3 s, the actor late. One corner of the area is left last.
    expected = 2.5 - (5.0 + 1.95) / 16.0 - (4.6 + 2.0) / 10.0
    assert result.pet_s == pytest.approx(expected, abs=0.051)
    assert result.ego_first is ego_first
    assert result.angle_rad == pytest.approx(LEFT, abs=1e-3)


def test_no_encounter_is_five_seconds_apart_or_with_who_stands() -> None:
    assert not crossing(6.5).encounters
    frames = [(ego_at(8.0 * k), (actor(40.0),)) for k in range(6)]
    assert not recorded(*frames).encounters


@pytest.mark.parametrize(
    ("ego", "other", "contact"),
    [
        (ego_at(speed=0.05), actor(9.0, speed=5.0), Contact.STANDING_EGO),
        (ego_at(), actor(9.0, kind=ActorKind.BARRIER), Contact.STANDING_PARTNER),
        (ego_at(), actor(0.5, speed=12.0), Contact.REAR),
        (ego_at(), actor(9.0, speed=2.0), Contact.FRONT),
        (ego_at(), actor(5.0, 1.9, 9.0), Contact.SIDE),
    ],
)
def test_how_two_came_together(ego: Ego, other: Actor, contact: Contact) -> None:
    assert contact_of(ego, other) is contact


@pytest.mark.parametrize(
    ("contact", "y", "fault"),
    [
        (Contact.STANDING_EGO, 0.0, False),
        (Contact.STANDING_PARTNER, 0.0, True),
        (Contact.REAR, 1.5, False),
        (Contact.FRONT, 0.0, True),
        (Contact.SIDE, 0.0, False),
        (Contact.SIDE, 1.5, True),
    ],
)
def test_whose_fault_it_was(contact: Contact, y: float, fault: bool) -> None:
    # at x = 5 the ego stands over the border of two lanes that follow each other
    assert at_fault(contact, ego_at(5.0, y), ROAD) is fault


def test_a_collision_is_written_with_how_fast_and_whose_fault() -> None:
    ego, other = ego_at(5.0), actor(9.0, speed=2.0)
    what = (50_000, EventKind.COLLISION, "the ego", ego.x, ego.y)
    scene = Scene(50_000, ego, (other,), ())
    world = SimpleNamespace(
        route=Route("r", "HighwayExit", 1),
        path=straight(),
        progress_m=10.0,
        events=(Event(*what, ego.speed_mps, other.id, other.kind),),
        roadmap=ROAD,
        collided={50_000: scene},
    )
    recorder = EpisodeRecorder(cast(World, world))
    recorder.record(scene)
    (result,) = recorder.episode(Ending.COLLISION).infractions

    assert (result.contact, result.at_fault) == (Contact.FRONT, True)
    assert result.ego_speed_mps == 8.0


# Boxes in the plane, by hand and against small steps of time.


CAR = np.array([0.0, 0.0, 0.0, 4.0, 2.0])


def box(x: float, y: float, heading: float = 0.0) -> np.ndarray:
    return np.array([x, y, heading, 4.0, 2.0])


places = st.floats(-12.0, 12.0)
boxes = st.builds(box, places, places, st.floats(-math.pi, math.pi))
speeds = st.tuples(st.floats(-9.0, 9.0), st.floats(-9.0, 9.0)).map(np.array)


@pytest.mark.parametrize(
    ("other", "metres"),
    [
        (box(10.0, 0.0), 6.0),
        (box(0.0, 5.0), 3.0),
        (box(7.0, 6.0), 5.0),
        (box(3.0, 1.0), 0.0),
        (box(0.0, 0.0), 0.0),
        (box(10.0, 0.0, math.pi / 2), 7.0),
        (box(5.0 + 3.0 / math.sqrt(2.0), 0.0, math.pi / 4), 3.0),
    ],
)
def test_the_gap_between_two_outlines(other: np.ndarray, metres: float) -> None:
    assert float(gaps(CAR, other)) == pytest.approx(metres)


def test_corners_of_a_turned_box() -> None:
    turned = corners(box(1.0, 2.0, math.pi / 2))

    assert turned == pytest.approx(np.array([[0, 4], [2, 4], [2, 0], [0, 0]]))


@pytest.mark.parametrize(
    ("other", "velocity", "seconds"),
    [
        (box(24.0, 0.0), (-10.0, 0.0), 2.0),
        (box(24.0, 0.0), (10.0, 0.0), math.inf),
        (box(24.0, 3.0), (-10.0, 0.0), math.inf),
        (box(24.0, 3.0), (-10.0, -0.4), 2.5),
        (box(3.0, 0.0), (0.0, 0.0), 0.0),
        (box(9.0, 0.0), (0.0, 0.0), math.inf),
    ],
)
def test_the_time_until_two_boxes_touch(
    other: np.ndarray, velocity: tuple[float, float], seconds: float
) -> None:
    assert float(contact_times(CAR, other, np.array(velocity))) == seconds


@given(boxes, boxes)
def test_a_gap_is_the_same_from_both_sides(one: np.ndarray, other: np.ndarray) -> None:
    there, back = float(gaps(one, other)), float(gaps(other, one))

    assert there == pytest.approx(back, abs=1e-9)
    assert (there == 0.0) == bool(overlaps(one, other))


@given(boxes, boxes, speeds)
def test_boxes_first_touch_at_the_time_of_contact(
    one: np.ndarray, other: np.ndarray, velocity: np.ndarray
) -> None:
    seconds = float(contact_times(one, other, velocity))
    times = np.linspace(0.0, 5.0, 101)
    moved = np.repeat(other[None], len(times), axis=0)
    moved[:, :2] += times[:, None] * velocity
    touching = gaps(one, moved) < 1e-9

    assert not touching[times < seconds - 1e-6].any()
    if seconds <= 5.0:
        arrived = other.copy()
        arrived[:2] += seconds * velocity
        assert float(gaps(one, arrived)) < 1e-6


# What of a scene is written down.


def traffic_speed(*actors: Actor) -> float | None:
    """Return the speed of the traffic that a frame keeps; the ego stands at (5, 0)."""
    recorder = EpisodeRecorder(cast(World, SimpleNamespace(progress_m=0.0)))
    recorder.record(Scene(0, ego_at(5.0, 0.0), actors, ()))
    (frame,) = recorder.frames
    return frame.traffic_speed_mps


WITHIN = [(7.0, 3.0), (26.0, 0.0), (54.9, 0.0), (-44.9, 0.0), (34.0, 40.0)]
BEYOND = [(55.1, 0.0), (-45.1, 0.0), (45.0, 40.0)]
NO_TRAFFIC = (ActorKind.PEDESTRIAN, ActorKind.PARKED, ActorKind.CONE)


@pytest.mark.parametrize(
    ("actors", "speed"),
    [
        *(([actor(*place, speed=6.0)], 6.0) for place in WITHIN),
        *(([actor(*place, speed=6.0)], None) for place in BEYOND),
        *(
            ([actor(40.0, speed=4.0), actor(*place, speed=6.0, number=2)], 4.0)
            for place in BEYOND
        ),
        ([actor(10.0, speed=9.0), actor(50.0, number=2)], 4.5),
        *(([actor(10.0, speed=1.0, kind=kind)], None) for kind in NO_TRAFFIC),
    ],
)
def test_vehicles_within_50_m_moving_or_not_are_the_traffic(
    actors: list[Actor], speed: float | None
) -> None:
    assert traffic_speed(*actors) == speed


@pytest.mark.parametrize(
    ("commands", "goal_m", "expected"),
    [
        ("FFFLLFFFFF", 9.0, 3 + 20.0),
        ("FFFFRFFFFF", 9.0, 4 + 20.0),
        ("FSFFRFFFFF", 9.0, 1 + 20.0),
        ("FFFCDFFFFF", 9.0, None),
        ("FFFFFFFFLL", 9.0, 8 + 20.0),
        ("FFFFFFFFFL", 9.0, None),
        ("FFFFFFFFFL", 9.5, 9 + 20.0),
    ],
)
def test_a_junction_is_20_m_behind_the_first_turn_that_comes_before_the_goal(
    commands: str, goal_m: float, expected: float | None
) -> None:
    names = dict(zip("LRSFCD", Command, strict=True))
    ahead = np.array([names[letter] for letter in commands], np.int64)
    path = SimpleNamespace(commands=ahead, goal_m=goal_m)

    assert junction_m(cast(RoutePath, path)) == expected
