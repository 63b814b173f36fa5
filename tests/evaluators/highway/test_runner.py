import dataclasses
import math
import re
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from me2e_compress.driving.contract import (
    Answer,
    Observation,
    PedalsAndWheel,
    RouteInfo,
)
from me2e_compress.driving.latency import FixedLatency
from me2e_compress.evaluators import Drive
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.evaluators.highway.observe import can_bus_of, road_users
from me2e_compress.evaluators.highway.runner import EndingRules, Listeners, drive
from me2e_compress.metrics.episode import Ending, InfractionKind
from me2e_compress.metrics.route_scores import route_score
from me2e_compress.shipped.drivers import shipped_model
from me2e_compress.simulator.pictures import Moment
from me2e_compress.simulator.routes import load_routes, pick_routes
from me2e_compress.simulator.scene import ActorKind, Ego
from me2e_compress.simulator.world import World
from models.driver.expert.blind import Blind
from tests.evaluators.highway.drivers import CROSSING, EXIT, GREEN, PARKED, Misbehaving

IDEAL = Drive()


@dataclass
class Standing:
    """Plans to stay where it is, and keeps what it was shown."""

    needs_images: bool = False
    privileged: bool = False
    plans: float = 0.0
    seen: list[Observation] = field(default_factory=list)
    resets: int = 0
    image_size: tuple[int, int] = (16, 16)

    def reset(self, route: RouteInfo) -> None:
        self.resets += 1

    def plan(self, observation: Observation) -> Answer:
        self.seen.append(observation)
        ahead = self.plans * 0.5 * np.arange(1, 7)
        return np.stack([ahead, np.zeros(6)], axis=1)


def test_a_blind_driver_ends_at_its_first_collision() -> None:
    episode = drive(PARKED, Blind(), IDEAL)

    assert episode.ending is Ending.COLLISION
    assert [i.kind for i in episode.infractions] == [InfractionKind.COLLISION_VEHICLE]
    assert 0.0 < episode.completion_percent < 100.0
    assert episode.infractions[0].time_us == episode.frames[-1].time_us
    hit = drive(CROSSING, Blind(), IDEAL).infractions
    assert InfractionKind.COLLISION_PEDESTRIAN in [
        infraction.kind for infraction in hit
    ]


def test_standing_still_is_blocked_after_a_minute() -> None:
    episode = drive(GREEN, Standing(), IDEAL)

    assert episode.ending is Ending.BLOCKED
    assert episode.infractions[-1].kind is InfractionKind.VEHICLE_BLOCKED
    still = [f.time_us for f in episode.frames if f.speed_mps <= 0.1]
    assert still[-1] - still[0] == 60_000_000


def test_the_same_route_drives_the_same() -> None:
    slow = Drive(FixedLatency(250_000))

    assert drive(EXIT, Blind(), slow) == drive(EXIT, Blind(), slow)


@pytest.mark.parametrize(
    ("latency_us", "dt_us", "period_us"),
    [
        (0, 50_000, 50_000),
        (99_999, 50_000, 50_000),
        (150_000, 50_000, 150_000),
        (250_000, 50_000, 250_000),
        (20_000, 10_000, 20_000),
    ],
)
def test_decisions_come_as_often_as_equation_4_lets_them(
    latency_us: int, dt_us: int, period_us: int
) -> None:
    episode = drive(PARKED, Blind(), Drive(FixedLatency(latency_us), dt_us))

    times = [decision.time_us for decision in episode.decisions]
    assert times == list(range(0, times[-1] + 1, period_us))
    assert {decision.latency_us for decision in episode.decisions} == {latency_us}
    assert [f.time_us for f in episode.frames[:3]] == [0, 50_000, 100_000]


def test_a_late_control_acts_late() -> None:
    """Equation 4 at 0.15 s: n = 2, so the first control acts in frame 3."""
    brakes_in = []
    for latency in (0, 150_000):
        frames = drive(PARKED, Standing(), Drive(FixedLatency(latency))).frames
        braking = (k for k, f in enumerate(frames) if f.acceleration_mps2 < -0.1)
        brakes_in.append(next(braking))

    assert brakes_in[1] - brakes_in[0] == 3


@pytest.mark.parametrize(
    ("way", "reason"),
    [
        ("no-reset", "RuntimeError: will not start"),
        ("raise", r"KeyError: 'lost\\nmy way'"),
        ("not-finite", "the plan is not finite"),
        ("shape", r"the plan has shape \[5, 2\], it must be \[6, 2\]"),
        ("integers", "the plan is not a float array but an array of int64"),
        ("list", "the plan is not a float array but list"),
        ("steers-too-far", "steer is 1.3, it must be from -1 to 1"),
        ("no-pedal", "throttle is nan, it must be from 0 to 1"),
    ],
)
def test_a_policy_that_breaks_its_contract_has_failed(way: str, reason: str) -> None:
    episode = drive(EXIT, Misbehaving(way), IDEAL)

    assert episode.ending is Ending.POLICY_FAILED
    assert episode.failure is not None
    assert len(episode.decisions) == (0 if way == "no-reset" else 19)
    assert bool(episode.completion_percent) == bool(episode.decisions)
    assert not episode.succeeded
    assert re.fullmatch(reason, episode.failure)


def test_a_policy_sees_what_it_may() -> None:
    plain, seeing = Standing(plans=8.0), Standing(needs_images=True, plans=8.0)
    seeing.image_size = (32, 48)
    drive(PARKED, plain, IDEAL)
    drive(PARKED, seeing, IDEAL)

    first = plain.seen[0]
    assert (first.images, first.scene, first.world) == (None, None, None)
    assert first.lidar2img.shape == (6, 4, 4)
    assert plain.resets == 1
    images = seeing.seen[0].images
    assert images is not None
    assert images.shape == (6, 32, 48, 3)
    assert images.dtype == np.uint8


def test_the_can_bus_counts_from_decision_to_decision() -> None:
    policy = Standing(plans=8.0)
    drive(PARKED, policy, Drive(FixedLatency(200_000)))
    first, second = policy.seen[:2]

    assert not first.can_bus[[0, 1, 2, 17]].any()
    speeds = (first.can_bus[7], second.can_bus[7])
    moved = float(np.hypot(*second.can_bus[:2]))
    assert 0.2 * min(speeds) - 0.05 <= moved <= 0.2 * max(speeds) + 0.05


def test_the_layout_of_the_can_bus() -> None:
    ego = Ego(3.0, 4.0, -0.5, 6.0, 1.5, -0.5, 0.25, 0.1, 4.9, 2.0)
    bus = can_bus_of(ego, dataclasses.replace(ego, x=1.0, y=5.0, heading=6.1831853))

    position, rotation = [2.0, -1.0, 0.0], [np.cos(-0.25), 0.0, 0.0, np.sin(-0.25)]
    motion = [6.0, 0.0, 0.0, 1.5, -0.5, 0.0, 0.0, 0.0, 0.25]
    turned = [2 * np.pi - 0.5, np.degrees(-0.5 + 0.1)]
    expected = np.array([*position, *rotation, *motion, *turned], np.float32)
    assert bus.dtype == np.float32
    assert bus == pytest.approx(expected, abs=1e-4)


class Pressing(Standing):
    """Answers full throttle, and no plan."""

    def plan(self, observation: Observation) -> Answer:
        return PedalsAndWheel(1.0, 0.0, 0.0)


def test_a_policy_of_controls_drives_and_shows_no_plan() -> None:
    """Full throttle is 4 m/s2; the latency holds for it as for a plan."""
    moments = list[Moment]()
    late = Drive(FixedLatency(150_000))

    episode = drive(PARKED, Pressing(), late, Listeners(on_moment=moments.append))

    assert episode.failure is None
    pushed = [frame.acceleration_mps2 for frame in episode.frames]
    assert pushed[3] == 0.0
    assert pushed[4] > 0.5
    assert max(pushed) == pytest.approx(4.0, rel=0.05)
    assert episode.conflicts is not None
    assert all(moment.plan is None for moment in moments)


def test_watching_changes_nothing() -> None:
    moments = list[Moment]()
    watched = drive(PARKED, Blind(), IDEAL, Listeners(on_moment=moments.append))

    assert watched == drive(PARKED, Blind(), IDEAL)
    assert len(moments) == len(watched.frames)
    assert moments[-1].events
    images = moments[0].images
    assert images is not None
    assert images.shape == (6, 96, 160, 3)


def test_a_held_plan_stays_where_it_was_made() -> None:
    """Seen from an ego that has moved on, its waypoints come nearer."""
    moments = list[Moment]()
    slow = Drive(FixedLatency(500_000))
    drive(PARKED, Standing(plans=8.0), slow, Listeners(on_moment=moments.append))
    first, later = moments[0], moments[9]
    assert first.plan is not None
    assert later.plan is not None

    np.testing.assert_allclose(
        later.scene.ego.placed(later.plan), first.scene.ego.placed(first.plan)
    )
    assert later.plan[3, 0] < first.plan[3, 0] - 1.0


def test_road_users_stand_in_the_ego_frame() -> None:
    scene = World(PARKED).scene()
    north = replace(scene.ego, x=0.0, y=0.0, heading=math.pi / 2)
    car = replace(scene.actors[0], kind=ActorKind.CAR, x=-3.0, y=20.0)
    cone = replace(car, kind=ActorKind.CONE)

    result = road_users(replace(scene, ego=north, actors=(car, cone)))

    assert result == pytest.approx(np.array([(20.0, 3.0)]))
    assert road_users(replace(scene, actors=())).shape == (0, 2)


@dataclass
class Track:
    """As much of a world as the rules look at."""

    speed_mps: float = 5.0
    lateral_m: float = 0.0
    time_us: int = 0
    reason: Ending | None = None
    path: SimpleNamespace = field(default_factory=lambda: SimpleNamespace(goal_m=200.0))


def ending_after(track: Track, seconds: float) -> tuple[Ending | None, float]:
    rules = EndingRules()
    while track.time_us < seconds * 1e6:
        track.time_us += 50_000
        ending = rules.ending(cast(World, track), track.speed_mps)
        if ending is not None:
            return ending, track.time_us / 1e6
    return None, track.time_us / 1e6


@pytest.mark.parametrize(
    ("track", "seconds", "expected"),
    [
        ({}, 300.0, (Ending.TIMEOUT, 200.0)),
        ({"speed_mps": 0.1}, 100.0, (Ending.BLOCKED, 60.05)),
        ({"speed_mps": 0.11}, 100.0, (None, 100.0)),
        ({"lateral_m": 29.9}, 0.2, (None, 0.2)),
        ({"lateral_m": -30.0}, 0.2, (Ending.DEVIATION, 0.05)),
        # far from it for 60 m, 30 % of 200 m, at 5 m/s
        ({"lateral_m": 14.9}, 20.0, (None, 20.0)),
        ({"lateral_m": 15.0}, 20.0, (Ending.DEVIATION, 12.05)),
        ({"reason": Ending.COMPLETED}, 1.0, (Ending.COMPLETED, 0.05)),
        ({"reason": Ending.COLLISION}, 1.0, (Ending.COLLISION, 0.05)),
    ],
)
def test_when_a_drive_ends(
    track: dict[str, Any], seconds: float, expected: tuple[Ending | None, float]
) -> None:
    assert ending_after(Track(**track), seconds) == expected


def test_moving_on_starts_the_minute_again() -> None:
    track, rules = Track(0.0), EndingRules()
    for second in range(100):
        track.speed_mps = 1.0 if second == 50 else 0.0
        track.time_us += 1_000_000
        assert rules.ending(cast(World, track), track.speed_mps) is None


# The weights that ship, in closed loop; five CPU seconds.


def test_the_shipped_driver_passes_a_parked_car() -> None:
    """A route that nobody passes blindly, and one of the shortest."""
    (route,) = pick_routes(load_routes(), "ParkedObstacle_R2_0")
    policy = OnnxDriver(shipped_model("highway")).open()

    episode = drive(route, policy, Drive())

    assert (episode.ending, episode.infractions) == (Ending.COMPLETED, ())
    assert (episode.completion_percent, episode.succeeded) == (100.0, True)
    assert episode.abilities == ("Overtaking",)
    assert episode.route_length_m > 50.0
    times = [frame.time_us for frame in episode.frames]
    assert times == list(range(0, times[-1] + 1, 50_000))
    assert len(episode.decisions) == len(episode.frames) - 1
    assert route_score(episode).composed == 100.0
