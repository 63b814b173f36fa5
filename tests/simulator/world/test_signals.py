import math

import pytest

from me2e_compress.simulator.scene import EventKind, SignalKind, SignalState
from me2e_compress.simulator.traffic.network import Pose
from me2e_compress.simulator.traffic.right_of_way import Regulator

LINE_S = 50.0


def regulator(kind: SignalKind, state: SignalState | None = None) -> Regulator:
    return Regulator(1, kind, Pose(0.0, 0.0, 0.0), LINE_S, state)


def drive(
    sign: Regulator, begin: float = 40.0, end: float = 60.0, speed: float = 5.0
) -> list[EventKind]:
    found, steps = list[EventKind](), round((end - begin) / 0.25)
    for k in range(steps + 1):
        centre = begin + 0.25 * k
        kind = sign.check(centre + 2.5, centre - 2.5, speed)
        found += [] if kind is None else [kind]
    return found


@pytest.mark.parametrize(
    ("state", "found"),
    [
        (SignalState.RED, [EventKind.RED_LIGHT]),
        (SignalState.YELLOW, []),
        (SignalState.GREEN, []),
    ],
)
def test_only_red_is_run(state: SignalState, found: list[EventKind]) -> None:
    assert drive(regulator(SignalKind.TRAFFIC_LIGHT, state)) == found


def test_the_tail_alone_decides_as_in_carla() -> None:
    light = regulator(SignalKind.TRAFFIC_LIGHT, SignalState.YELLOW)
    drive(light, 40.0, 48.0)
    light.state = SignalState.RED

    assert drive(light, 48.0, 60.0) == [EventKind.RED_LIGHT]


def test_who_waits_with_the_nose_over_the_line_may_go_on_green() -> None:
    light = regulator(SignalKind.TRAFFIC_LIGHT, SignalState.RED)
    drive(light, 40.0, 48.0)
    light.state = SignalState.GREEN

    assert drive(light, 48.0, 60.0) == []


@pytest.mark.parametrize(
    ("rest_at", "found"), [(45.0, []), (35.0, [EventKind.STOP_SIGN])]
)
def test_a_stop_counts_only_near_the_line(
    rest_at: float, found: list[EventKind]
) -> None:
    sign = regulator(SignalKind.STOP_SIGN)
    sign.check(rest_at + 2.5, rest_at - 2.5, 0.0)

    assert drive(sign) == found


@pytest.mark.parametrize(
    ("seconds", "found"), [(0.8, [EventKind.GIVE_WAY]), (3.0, []), (math.inf, [])]
)
def test_giving_way_means_leaving_a_gap_at_the_conflict(
    seconds: float, found: list[EventKind]
) -> None:
    sign = regulator(SignalKind.GIVE_WAY)
    sign.conflict_s, sign.nearest_s = 58.0, lambda: seconds

    assert drive(sign, end=70.0) == found


def test_a_signal_off_the_route_is_nobodys_business() -> None:
    light = regulator(SignalKind.TRAFFIC_LIGHT, SignalState.RED)
    light.line_s = None

    assert drive(light) == []


def test_the_stop_line_lies_across_the_lane() -> None:
    sign = Regulator(1, SignalKind.STOP_SIGN, Pose(3.0, 4.0, math.pi / 2), 50.0)

    (x1, y1), (x2, y2) = sign.snapshot().stop_line

    assert (x1, y1) == pytest.approx((1.25, 4.0))
    assert (x2, y2) == pytest.approx((4.75, 4.0))
