import math
from dataclasses import replace

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
)
from models.driver.expert.visibility import RANGE_M, seen

EGO = Ego(0.0, 0.0, 0.0, 8.0, 0.0, 0.0, 0.0, 0.0, 5.0, 2.0)


def actor(number: int, kind: ActorKind, x: float, y: float) -> Actor:
    return Actor(number, kind, x, y, 0.0, 1.0, *DIMENSIONS[kind], False, 0)


def shown(*actors: Actor, ego: Ego = EGO) -> list[int]:
    return [each.id for each in seen(Scene(0, ego, actors, ())).actors]


VAN = (ActorKind.VAN, 20.0, -3.0)


@pytest.mark.parametrize(
    ("near", "far", "seen"),
    [
        (VAN, (ActorKind.PEDESTRIAN, 24.0, -3.6), False),
        (VAN, (ActorKind.PEDESTRIAN, 24.0, 0.0), True),  # beside it
        ((ActorKind.TRUCK, 12.0, 0.0), (ActorKind.CAR, 30.0, 0.0), False),
        ((ActorKind.TRUCK, -12.0, 0.0), (ActorKind.CAR, -30.0, 0.0), False),
        ((ActorKind.CONE, 20.0, 0.0), (ActorKind.TRUCK, 40.0, 0.0), True),  # over it
    ],
)
def test_who_is_hidden_behind_whom(
    near: tuple[ActorKind, float, float],
    far: tuple[ActorKind, float, float],
    seen: bool,
) -> None:
    assert shown(actor(1, *near), actor(2, *far)) == ([1, 2] if seen else [1])


def test_who_steps_out_halfway_is_seen() -> None:
    parked = actor(1, ActorKind.PARKED, 20.0, -3.0)
    found = [
        2 in shown(parked, actor(2, ActorKind.PEDESTRIAN, 23.5, y / 10))
        for y in range(-60, 0)
    ]

    assert not found[10]
    assert found[-1]


def test_far_away_nothing_is_seen_signals_included() -> None:
    lines = ((0.0, 0.0), (0.0, 3.0))
    light = Signal(1, SignalKind.STOP_SIGN, RANGE_M + 1.0, 0.0, 0.0, None, lines)
    near = replace(light, id=2, x=RANGE_M - 1.0)
    far = actor(1, ActorKind.CAR, RANGE_M + 1.0, 0.0)
    scene = seen(Scene(0, EGO, (far,), (light, near)))

    assert scene.actors == ()
    assert shown() == []
    assert [each.id for each in scene.signals] == [2]


@given(
    st.lists(
        st.tuples(st.floats(-70, 70), st.floats(-70, 70), st.floats(-3, 3)), max_size=8
    ),
    st.floats(-3, 3),
)
def test_one_more_hides_others_and_never_shows_them(
    places: list[tuple[float, float, float]], heading: float
) -> None:
    ego = replace(EGO, heading=heading)
    cars = [
        replace(actor(number, ActorKind.CAR, x, y), heading=turn)
        for number, (x, y, turn) in enumerate(places)
        if abs(x) + abs(y) > 8.0
    ]
    alone = [each for each in cars if math.hypot(each.x, each.y) < RANGE_M]

    assert [shown(each, ego=ego) for each in alone] == [[each.id] for each in alone]
    if cars:
        fewer = shown(*cars[:-1], ego=ego)
        assert set(fewer) >= set(shown(*cars, ego=ego)) - {cars[-1].id}
