import dataclasses

import numpy as np
import numpy.typing as npt
import pytest

from me2e_compress.metrics import bench2drive
from me2e_compress.metrics.episode import EgoFrame, Ending, Episode
from me2e_compress.metrics.route_scores import (
    comfort,
    efficiency,
    smooth_frames,
    speed_ratios,
)
from tests.metrics.drives import cruise, drive, frames

Floats = npt.NDArray[np.float64]
A, B, W = "acceleration_mps2", "lateral_acceleration_mps2", "yaw_rate_radps"


def steady(count: int, **values: float) -> Episode:
    return drive(driven=frames(count, lambda _: dict(values)))


def random_frames(seed: int, count: int) -> tuple[EgoFrame, ...]:
    rng = np.random.default_rng(seed)
    along, left = rng.normal(0, 1.5, (2, count)).cumsum(axis=1) * 0.3
    yaw = rng.normal(0, 0.1, count).cumsum() * 0.3
    heading = (yaw * 0.05).cumsum()
    columns = {A: along, B: left, W: yaw, "heading": heading}
    return frames(
        count, lambda k: {name: float(column[k]) for name, column in columns.items()}
    )


def local_fit(values: Floats, dt: float) -> tuple[Floats, Floats]:
    """Fit a parabola to seven neighbours of each sample: value and slope there."""
    fitted, slopes = np.empty_like(values), np.empty_like(values)
    for k in range(len(values)):
        start = min(max(k - 3, 0), len(values) - 7)
        times = (np.arange(start, start + 7) - k) * dt
        seven = values[start : start + 7]
        value, slope, _ = np.polynomial.polynomial.polyfit(times, seven, 2)
        fitted[k], slopes[k] = value, slope
    return fitted, slopes


def columns(driven: tuple[EgoFrame, ...]) -> tuple[Floats, Floats, Floats, Floats]:
    a, b, w, heading = (
        np.array([getattr(frame, name) for frame in driven])
        for name in (A, B, W, "heading")
    )
    return a, b, w, heading


@pytest.mark.parametrize("seed", range(3))
def test_si_comfort_against_local_fits(seed: int) -> None:
    driven = random_frames(seed, 93)
    along, left, yaw, heading = columns(driven)
    a, jerk_along = local_fit(along, 0.05)
    b, _ = local_fit(left, 0.05)
    w, spin = local_fit(yaw, 0.05)
    east = local_fit(along * np.cos(heading) - left * np.sin(heading), 0.05)[1]
    north = local_fit(along * np.sin(heading) + left * np.cos(heading), 0.05)[1]
    fine = (a >= -4.05) & (a <= 2.40) & (abs(b) <= 4.89) & (abs(w) <= 0.95)
    fine &= (abs(spin) <= 1.93) & (abs(jerk_along) <= 4.13)
    fine &= np.sqrt(east**2 + north**2) <= 8.37

    assert smooth_frames(drive(driven=driven)).tolist() == fine.tolist()
    whole = [fine[k : k + 20].all() for k in range(0, 80, 20)]
    assert comfort(drive(driven=driven)).value == np.mean(whole)


@pytest.mark.parametrize(
    ("name", "inside", "outside"),
    [
        *((A, 2.39, 2.41), (A, -4.04, -4.06), (B, 4.88, 4.90), (B, -4.88, -4.90)),
        *((W, 0.94, 0.96), (W, -0.94, -0.96)),
    ],
)
def test_bounds_of_the_three_levels(name: str, inside: float, outside: float) -> None:
    assert comfort(steady(40, **{name: inside})).value == 1.0
    assert comfort(steady(40, **{name: outside})).value == 0.0


@pytest.mark.parametrize(
    ("name", "inside", "outside", "times"),
    [
        *((A, 4.12, 4.14, 1), (B, 8.36, 8.38, 1), (W, 1.92, 1.94, 1)),
        (A, 2.4, 4.2, 2),  # at 10 Hz the level stays in range up to 2.4 / 0.95
    ],
)
def test_bounds_of_the_three_slopes(
    name: str, inside: float, outside: float, times: int
) -> None:
    def ramp(slope: float) -> Episode:
        # 20 frames of 0.05 s around zero: the level stays in range, the slope decides.
        rise = slope * 0.05 * times
        driven = frames(20, lambda k: {name: rise * (k - 9.5)})
        slow = (dataclasses.replace(f, time_us=times * f.time_us) for f in driven)
        return drive(driven=tuple(slow))

    assert comfort(ramp(inside)).value == 1.0
    assert comfort(ramp(outside)).value == 0.0


def test_fewer_than_20_frames_and_an_incomplete_segment_are_left_out() -> None:
    rough = drive(driven=frames(39, lambda k: {A: 3.0 if k > 30 else 0.0}))

    assert comfort(steady(19)).reason == "19 frames, 20 are needed"
    assert comfort(steady(20)).value == 1.0
    assert comfort(rough).value == 1.0


@pytest.mark.parametrize(("intervals", "value"), [(1200, 1.0), (1199, 0.0)])
def test_standing_blocked_is_not_uncomfortable(intervals: int, value: float) -> None:
    shaken = steady(intervals + 1, speed_mps=0.05, lateral_acceleration_mps2=6.0)
    ended = dataclasses.replace(shaken, ending=Ending.BLOCKED)

    assert comfort(shaken).value == value
    assert comfort(ended).value == 1.0


def original(driven: tuple[EgoFrame, ...]) -> list[bool]:
    """Bench2Drive's blocks, filters spelled out as local fits (delta 0.1 s)."""
    along, left, yaw, _ = columns(driven)
    omega, norm = np.degrees(yaw), np.hypot(along, left)
    blocks = []
    for k in range(0, len(driven) - 19, 20):
        part = slice(k, k + 20)
        a, _ = local_fit(along[part], 0.1)
        b, _ = local_fit(left[part], 0.1)
        m, _ = local_fit(norm[part], 0.1)
        raw = omega[part]
        turns = np.concatenate([[0.0], np.cumsum(np.round(np.diff(raw) / 6.283185307))])
        w, _ = local_fit(raw - 2 * np.pi * turns, 0.1)
        fine = (a > -4.05) & (a < 2.40) & (abs(b) < 4.89) & (abs(w) < 0.95)
        fine &= (abs(local_fit(m, 0.1)[1]) < 8.37) & (abs(local_fit(a, 0.1)[1]) < 4.13)
        blocks.append(bool(fine.all()))
    return blocks


@pytest.mark.parametrize("seed", range(3))
def test_bench2drive_smoothness_against_local_fits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    calm = random_frames(seed, 215)
    scale = float(rng.uniform(0.01, 0.2))
    driven = tuple(
        dataclasses.replace(f, yaw_rate_radps=f.yaw_rate_radps * scale) for f in calm
    )

    result = bench2drive.smoothness(drive(driven=driven))
    assert result.value == np.mean(original(driven))


def test_bench2drive_judges_short_routes_as_one_block() -> None:
    assert bench2drive.smoothness(steady(3)).value == 1.0
    assert bench2drive.smoothness(steady(12, acceleration_mps2=2.5)).value == 0.0
    assert bench2drive.smoothness(steady(2)).reason == "2 frames, 3 are needed"


def random_drive(seed: int, completed: bool = True) -> Episode:
    """Speeds of ego and traffic wander; traffic is sometimes out of sight."""
    rng = np.random.default_rng(seed)
    length = float(rng.uniform(80.0, 160.0))
    end = length if completed else 0.6 * length
    driven, route = list[EgoFrame](), 0.0
    while route < end:
        speed = float(rng.uniform(0.2, 12.0))
        traffic = float(rng.uniform(0.0, 9.0)) if rng.random() < 0.6 else None
        change = {"speed_mps": speed, "route_m": route, "traffic_speed_mps": traffic}
        [frame] = frames(1, lambda _, change=change: change)  # type: ignore[misc]
        driven.append(dataclasses.replace(frame, time_us=len(driven) * 50_000))
        route += 0.05 * speed
    percent = 100.0 if completed else 60.0
    ending = Ending.COMPLETED if completed else Ending.COLLISION
    return drive(
        completion=percent, driven=tuple(driven), ending=ending, length_m=length
    )


def by_hand(episode: Episode) -> list[float]:
    """Assign every frame to its check point first, then divide."""
    spacing = episode.route_length_m / 20
    groups = dict[int, list[EgoFrame]]()
    before = 0
    for frame in episode.frames:
        groups.setdefault(before, []).append(frame)
        before = max(before, int(frame.route_m / spacing))
    if episode.ending is not Ending.COMPLETED:
        last = max(groups)
        if int(groups[last][-1].route_m / spacing) == last:
            del groups[last]
    ratios = []
    for group in groups.values():
        near = [frame for frame in group if frame.traffic_speed_mps is not None]
        pairs = [(frame.speed_mps, frame.traffic_speed_mps or 0.0) for frame in near]
        if pairs and np.sum(pairs, axis=0)[1] > 0:
            ego, traffic = np.mean(pairs, axis=0)
            ratios.append(100 * ego / traffic)
    return ratios


@pytest.mark.parametrize("completed", [True, False])
@pytest.mark.parametrize("seed", range(5))
def test_check_points_against_brute_force(seed: int, completed: bool) -> None:
    episode = random_drive(seed, completed)
    expected = by_hand(episode)

    assert speed_ratios(episode) == pytest.approx(expected)
    kept = [ratio for ratio in expected if ratio <= 1000]
    assert efficiency(episode).value == pytest.approx(np.mean(kept))


def test_outliers_are_dropped_and_exactly_1000_percent_is_kept() -> None:
    measured = efficiency(drive(driven=cruise(speed=10.0, traffic=0.5)))

    assert measured.reason == "no check point saw moving traffic"
    assert efficiency(drive(ratios=(1000.0, 1000.1, 500.0))).value == 750.0


def test_no_traffic_is_not_measured_but_100_for_bench2drive() -> None:
    episode = drive(driven=cruise())

    assert efficiency(episode).value is None
    assert bench2drive.efficiency(episode).value == 100.0


def test_a_route_that_ends_in_its_first_twentieth_has_none() -> None:
    reason = efficiency(drive(completion=4.9, driven=cruise(traffic=5.0)[:10])).reason

    assert reason == "the ego did not pass the first 5 % of the route"


def test_bench2drive_writes_the_last_check_point_twice() -> None:
    episode = drive(driven=cruise(length_m=104.0, speed=10.0, traffic=4.0))
    episode = dataclasses.replace(episode, route_length_m=104.0)

    ratios = bench2drive.speed_ratios(episode)

    assert ratios[-1] == ratios[-2] == 250.0
    # Whole metres must exceed 5.2, so a check point comes every 6 m: 17 and the rest.
    assert len(ratios) == 17 + 2


@pytest.mark.parametrize(("completion", "value"), [(95.0, 70.0), (95.1, 80.0)])
def test_beyond_95_percent_the_last_ratio_stands_twice(
    completion: float, value: float
) -> None:
    episode = drive(completion=completion, ratios=(80.0, 120.0, 40.0, 40.0))

    assert efficiency(episode).value == value
    assert bench2drive.efficiency(episode).value == 70.0
