from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import cast

import pytest

from me2e_compress.evaluators.highway.runner import EndingRules
from me2e_compress.metrics.episode import Ending
from me2e_compress.simulator.world import EndReason, World


@dataclass
class Track:
    """As much of a world as the rules look at."""

    speed_mps: float = 5.0
    lateral_m: float = 0.0
    time_us: int = 0
    reason: EndReason | None = None
    path: SimpleNamespace = field(default_factory=lambda: SimpleNamespace(goal_m=200.0))


def ending_after(track: Track, seconds: float) -> tuple[Ending | None, float]:
    rules = EndingRules()
    while track.time_us < seconds * 1e6:
        track.time_us += 50_000
        ending = rules.ending(cast(World, track), track.speed_mps)
        if ending is not None:
            return ending, track.time_us / 1e6
    return None, track.time_us / 1e6


def test_a_normal_drive_goes_on() -> None:
    assert ending_after(Track(), 150.0) == (None, 150.0)


def test_200_seconds_are_the_end() -> None:
    assert ending_after(Track(), 300.0) == (Ending.TIMEOUT, 200.0)


@pytest.mark.parametrize(("speed", "ended"), [(0.1, True), (0.11, False)])
def test_a_minute_at_walking_away_pace_is_blocked(speed: float, ended: bool) -> None:
    ending, seconds = ending_after(Track(speed), 100.0)

    assert (ending is Ending.BLOCKED) is ended
    assert seconds == (60.05 if ended else 100.0)


def test_moving_on_starts_the_minute_again() -> None:
    track, rules = Track(0.0), EndingRules()
    for second in range(100):
        track.speed_mps = 1.0 if second == 50 else 0.0
        track.time_us += 1_000_000
        assert rules.ending(cast(World, track), track.speed_mps) is None


@pytest.mark.parametrize(("away", "ended"), [(29.9, None), (-30.0, Ending.DEVIATION)])
def test_30_metres_from_the_route_is_a_deviation(
    away: float, ended: Ending | None
) -> None:
    assert ending_after(Track(lateral_m=away), 0.2)[0] is ended


@pytest.mark.parametrize(
    ("away", "expected"), [(14.9, (None, 20.0)), (15.0, (Ending.DEVIATION, 12.05))]
)
def test_a_third_of_the_route_far_from_it_is_a_deviation(
    away: float, expected: tuple[Ending | None, float]
) -> None:
    # 60 m, 30 % of 200 m, at 5 m/s.
    assert ending_after(Track(lateral_m=away), 20.0) == expected


@pytest.mark.parametrize(
    ("reason", "ending"),
    [(EndReason.GOAL, Ending.COMPLETED), (EndReason.COLLISION, Ending.COLLISION)],
)
def test_the_world_may_end_by_itself(reason: EndReason, ending: Ending) -> None:
    assert ending_after(Track(reason=reason), 1.0) == (ending, 0.05)
