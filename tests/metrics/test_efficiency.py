import dataclasses

import numpy as np
import pytest

from me2e_compress.metrics import bench2drive
from me2e_compress.metrics.episode import EgoFrame, Ending, Episode
from me2e_compress.metrics.route_scores import efficiency, speed_ratios
from tests.metrics.drives import cruise, drive, frames


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
        pairs = [
            (f.speed_mps, f.traffic_speed_mps)
            for f in group
            if f.traffic_speed_mps is not None
        ]
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


def test_twice_as_fast_as_traffic_is_200_percent() -> None:
    episode = drive(driven=cruise(speed=10.0, traffic=5.0))

    assert speed_ratios(episode) == pytest.approx([200.0] * 20)
    assert efficiency(episode).value == pytest.approx(200.0)


def test_outliers_are_dropped() -> None:
    episode = drive(driven=cruise(speed=10.0, traffic=0.5))

    measured = efficiency(episode)

    assert measured.value is None
    assert measured.reason == "no check point saw moving traffic"


def test_exactly_1000_percent_is_kept() -> None:
    assert efficiency(drive(ratios=(1000.0, 1000.1, 500.0))).value == 750.0


def test_no_traffic_is_not_measured_but_100_for_bench2drive() -> None:
    episode = drive(driven=cruise())

    assert efficiency(episode).value is None
    assert bench2drive.efficiency(episode).value == 100.0


def test_a_route_that_ends_in_its_first_twentieth_has_none() -> None:
    episode = drive(completion=4.9, driven=cruise(traffic=5.0)[:10])

    assert efficiency(episode).reason == (
        "the ego did not pass the first 5 % of the route"
    )


def test_bench2drive_writes_the_last_check_point_twice() -> None:
    episode = drive(driven=cruise(length_m=104.0, speed=10.0, traffic=4.0))
    episode = dataclasses.replace(episode, route_length_m=104.0)

    ratios = bench2drive.speed_ratios(episode)

    assert ratios[-1] == ratios[-2] == 250.0
    # Whole metres must exceed 5.2, so a check point comes every 6 m: 17 and the rest.
    assert len(ratios) == 17 + 2


def test_given_ratios_are_taken_and_their_repetition_known() -> None:
    episode = drive(ratios=(80.0, 120.0, 40.0, 40.0))

    assert efficiency(episode).value == 80.0
    assert bench2drive.efficiency(episode).value == 70.0


@pytest.mark.parametrize(("completion", "value"), [(95.0, 70.0), (95.1, 80.0)])
def test_beyond_95_percent_the_last_ratio_stands_twice(
    completion: float, value: float
) -> None:
    episode = drive(completion=completion, ratios=(80.0, 120.0, 40.0, 40.0))

    assert efficiency(episode).value == value
