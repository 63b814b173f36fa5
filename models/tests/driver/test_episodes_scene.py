"""One instant as arrays: agents, their futures, signals."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.simulator.scene import (
    DIMENSIONS,
    Actor,
    ActorKind,
    Ego,
    Scene,
    Signal,
    SignalKind,
    SignalState,
)
from models.driver.episodes import GRID
from models.driver.episodes.agents import agents
from models.driver.episodes.episode_arrays import Arrays, signals
from models.driver.episodes.recording_policy import LabelledFrame
from models.driver.expert.expert_policy import ExpertDecision, Memory
from models.driver.expert.privileged import Phase

NORTH = Ego(100.0, 50.0, math.pi / 2, 8.0, 0.0, 0.0, 0.0, 0.0, 5.0, 2.0)
"""Looks north: 10 m ahead is (100, 60), 3 m to its left (97, 50)."""
LIGHT = SignalKind.TRAFFIC_LIGHT


def actor(
    number: int,
    ahead: float,
    left: float,
    kind: ActorKind = ActorKind.CAR,
    heading: float = math.pi / 2,
    speed: float = 0.0,
) -> Actor:
    x, y = NORTH.x - left, NORTH.y + ahead
    size = DIMENSIONS[kind]
    return Actor(number, kind, x, y, heading, speed, *size, number == 7, 0)


def scene(*actors: Actor, signals: tuple[Signal, ...] = ()) -> Scene:
    return Scene(0, NORTH, actors, signals)


def occupied(arrays: Arrays) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return np.unpackbits(arrays["occupancy"], axis=1).reshape(6, 64, 48)


def test_an_agent_is_told_in_the_ego_frame() -> None:
    west = actor(7, 10.0, 3.0, heading=math.pi, speed=5.0)

    rows = agents(scene(west), [None] * 6)["agents"]

    assert rows[0] == pytest.approx([0, 10, 3, 0, 1, 4.6, 1.95, 0, 5, 1], abs=1e-5)
    assert np.all(rows[1:, 0] == -1)
    assert np.all(rows[1:, 1:] == 0)


@pytest.mark.parametrize(
    ("kind", "number"),
    [
        (ActorKind.TRUCK, 0),
        (ActorKind.PARKED, 0),
        (ActorKind.DOOR, 0),
        (ActorKind.BICYCLE, 1),
        (ActorKind.PEDESTRIAN, 2),
        (ActorKind.CONE, 3),
        (ActorKind.BARRIER, 3),
    ],
)
def test_classes(kind: ActorKind, number: int) -> None:
    assert agents(scene(actor(1, 5, 5, kind)), [None] * 6)["agents"][0, 0] == number


@pytest.mark.parametrize(
    ("ahead", "left", "kept"),
    [
        *((47.9, 0, 1), (48.1, 0, 0), (-15.9, 0, 1), (-16.1, 0, 0)),
        *((0, 23.9, 1), (0, 24.1, 0), (0, -23.9, 1), (0, -24.1, 0)),
    ],
)
def test_who_is_near(ahead: float, left: float, kept: int) -> None:
    rows = agents(scene(actor(1, ahead, left)), [None] * 6)["agents"]

    assert np.sum(rows[:, 0] >= 0) == kept


def test_the_nearest_come_first_and_the_others_fall_off() -> None:
    crowd = [actor(k, 1.0 + k, 0.0, ActorKind.CONE) for k in range(30)]

    rows = agents(scene(*reversed(crowd)), [None] * 6)["agents"]

    assert rows[:, 1] == pytest.approx(np.arange(1.0, 25.0))


def test_a_future_is_seen_from_the_ego_of_now() -> None:
    later = [scene(actor(2, 10.0 + k, 4.0), actor(1, -5.0, k)) for k in range(6)]

    ways = agents(scene(actor(1, -5.0, 0.0), actor(2, 10.0, 4.0)), later)["futures"]

    assert ways[0] == pytest.approx(np.array([(-5.0, k) for k in range(6)]), abs=1e-5)
    assert ways[1] == pytest.approx(
        np.array([(10.0 + k, 4.0) for k in range(6)]), abs=1e-5
    )
    assert np.isnan(ways[2:]).all()


def test_who_is_gone_has_no_future_and_after_the_end_nothing_is_occupied() -> None:
    car = actor(1, 10.0, 0.0)

    arrays = agents(scene(car), [scene(car), scene(), scene(), None, None, None])

    assert np.isnan(arrays["futures"][0, 1:]).all()
    assert arrays["known_steps"] == 3
    filled = occupied(arrays).any(axis=(1, 2))
    assert filled.tolist() == [True, *[False] * 5]


def test_who_comes_later_is_occupied_too() -> None:
    arrays = agents(scene(), [scene(actor(9, 20.0, -6.0))] * 6)

    rows, columns = np.nonzero(occupied(arrays)[0])
    assert np.mean(GRID.front_m - rows - 0.5) == pytest.approx(20.0, abs=0.5)
    assert np.mean(GRID.left_m - columns - 0.5) == pytest.approx(-6.0, abs=0.5)


@given(st.floats(-14, 46), st.floats(-22, 22), st.floats(-4, 4))
def test_the_centre_of_an_actor_is_occupied(
    ahead: float, left: float, heading: float
) -> None:
    arrays = agents(scene(), [scene(actor(1, ahead, left, heading=heading))] * 6)

    column, row = GRID.cells(np.array([ahead, left]))
    assert occupied(arrays)[5, int(row), int(column)]


def frame(
    *lights: Signal, phases: tuple[Phase, ...], served: int = -1
) -> LabelledFrame:
    memory = Memory(served=frozenset({served}))
    decision = ExpertDecision(np.zeros((6, 2)), 0.0, 0.0, memory)
    return LabelledFrame(scene(signals=lights), phases, 3, Memory(), decision)


def signal(
    number: int,
    ahead: float,
    kind: SignalKind = LIGHT,
    state: SignalState | None = SignalState.RED,
) -> Signal:
    y = NORTH.y + ahead
    line = ((100.0, y), (104.0, y))
    return Signal(number, kind, NORTH.x + 4.0, y, math.pi, state, line)


def test_a_signal_is_told_in_the_ego_frame() -> None:
    phase = Phase(5, 32.0, SignalState.YELLOW)

    rows = signals(
        frame(signal(5, 12.0, state=SignalState.YELLOW), phases=(phase,)), 20.0
    )

    assert rows[0] == pytest.approx([0, 1, 12, -4, 0, 1, 12, 0], abs=1e-5)


def test_four_signals_at_most_those_of_the_route_first() -> None:
    far, near, nearer = signal(1, 40.0), signal(2, 9.0), signal(3, 5.0)
    crowd = [signal(k, 10.0 * k, SignalKind.GIVE_WAY, None) for k in range(6)]

    none = signals(frame(phases=()), 0.0)
    some = signals(frame(near, nearer, far, phases=(Phase(1, 60.0, None),)), 0.0)
    many = signals(frame(*crowd, phases=()), 0.0)

    assert np.all(none[:, :2] == -1)
    assert np.isnan(none[:, 6]).all()
    assert some[:3, 2] == pytest.approx([40.0, 5.0, 9.0])
    assert np.isnan(some[:, 6]).tolist() == [False, True, True, True]
    assert many[:, 2] == pytest.approx([0.0, 10.0, 20.0, 30.0])
    assert np.all(many[:, :2] == [2, -1])


def test_a_served_stop_is_told() -> None:
    stops = [signal(k, 10.0 * k, SignalKind.STOP_SIGN, None) for k in (1, 2)]

    rows = signals(frame(*stops, phases=(), served=2), 0.0)

    assert rows[:2, 7].tolist() == [0.0, 1.0]
