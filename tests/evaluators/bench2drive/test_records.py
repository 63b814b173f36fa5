import math
from typing import Any

import pytest

from me2e_compress.evaluators.bench2drive.recordings import (
    BrokenRecordingError,
    read_recording,
)
from me2e_compress.evaluators.bench2drive.result_files import (
    BrokenRecordError,
    number_of,
    read_record,
)
from me2e_compress.metrics import bench2drive
from me2e_compress.metrics.episode import Ending, Given, InfractionKind
from me2e_compress.metrics.route_scores import comfort, route_score
from tests.evaluators.bench2drive.files import (
    OUTSIDE,
    RAMMED,
    Json,
    record,
    recording,
    speed,
)
from tests.metrics.drives import drive


def test_a_record_becomes_an_episode() -> None:
    raw = record(
        score=(80.0, 0.56328, 45.0624),
        status="Failed - Agent got blocked",
        collisions_vehicle=[RAMMED],
        outside_route_lanes=[OUTSIDE],
        min_speed_infractions=[speed(131.0), speed(54.5)],
        vehicle_blocked=["Agent got blocked at (x=1.0, y=2.0, z=0.1)"],
    )

    read = read_record(raw)

    episode = read.episode
    assert (episode.route, read.number) == ("RouteScenario_1711_rep0", "1711")
    assert number_of("17") == "17"
    assert episode.scenario == "ParkingCutIn"
    assert episode.abilities == ("Emergency_Brake",)
    assert episode.ending is Ending.BLOCKED
    assert episode.speed_ratios_percent == (131.0, 54.5)
    assert episode.given == Given("Failed - Agent got blocked", 80.0, 0.56328, 45.0624)
    rammed, outside, *_ = episode.infractions
    assert (rammed.x, rammed.y, rammed.time_us) == (3130.105, -5245.413, None)
    assert outside.percent == 6.12
    # what was computed from the lists agrees with what was given
    assert route_score(episode).penalty == 0.56328
    assert route_score(episode).composed == 45.0624


@pytest.mark.parametrize(
    ("status", "ending", "crashed"),
    [
        ("Completed", Ending.COMPLETED, False),
        ("Perfect", Ending.COMPLETED, False),
        ("Failed - TickRuntime", Ending.TIMEOUT, False),
        ("Failed - Agent timed out", Ending.TIMEOUT, False),
        ("Failed - Agent deviated from the route", Ending.DEVIATION, False),
        ("Failed - Agent crashed", Ending.POLICY_FAILED, True),
        ("Failed - Agent couldn't be set up", Ending.POLICY_FAILED, True),
        ("Failed - Agent's sensors were invalid", Ending.POLICY_FAILED, True),
        ("Failed - Simulation crashed", Ending.SIMULATOR_FAILED, True),
        ("Failed", Ending.SIMULATOR_FAILED, True),
    ],
)
def test_every_status_has_an_ending(status: str, ending: Ending, crashed: bool) -> None:
    read = read_record(record(status=status))

    assert read.episode.ending is ending
    assert read.crashed is crashed


def test_a_crash_before_the_first_tick() -> None:
    raw = record(status="Failed - Simulation crashed", score=(0, 1.0, 0))
    raw["meta"] = {"route_length": 0, "duration_game": 0, "duration_system": 0.1}

    read = read_record(raw)

    assert read.episode.completion_percent == 0.0
    assert read.duration_s is None


def test_speeds_beyond_all_bounds_stay_finite_and_none_is_named() -> None:
    huge = "9" * 400
    read = read_record(record(min_speed_infractions=[speed(12.5), f"{huge}% of it"]))

    assert read.episode.speed_ratios_percent == (12.5, 1e9)
    read = read_record(record(min_speed_infractions=["Average speed is nan% of it"]))
    [note] = read.notes
    words = "no percentage in 'Average speed is nan% of it': left out"
    assert note == f"min_speed_infractions: {words}"
    assert read.episode.speed_ratios_percent == ()


def without(key: str) -> Json:
    raw = record()
    del raw[key]
    return raw


def scored(value: object) -> Json:
    raw = record()
    raw["scores"]["score_composed"] = value
    return raw


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        (without("status"), "status: Field required"),
        (without("scores"), "scores: Field required"),
        (scored(math.nan), "scores.score_composed: Input should be"),
        (scored(math.inf), "scores.score_composed: Input should be"),
        (scored("high"), "scores.score_composed: Input should be"),
        (record(score=(140.0, 1.0, 140.0)), "scores.score_route: Input should be less"),
        (record(status="Started"), "status 'Started' is not that of a finished route"),
        (record(status="Failed - why"), "'Failed - why' is not that of a finished"),
        (record(score=(80, 1.0, 101)), "score_composed: Input should be less than or"),
        (record(score=(80, -0.5, 0)), "score_penalty: Input should be greater than"),
        ({**record(), "route_id": "../x"}, "route_id: '../x' is no name"),
        ([], "record: Input should be"),
        (
            {**record(), "infractions": {"ran_over_a_cat": ["once"]}},
            "infractions: nobody knows 'ran_over_a_cat'",
        ),
    ],
)
def test_a_broken_record_is_one_line(raw: object, message: str) -> None:
    with pytest.raises(BrokenRecordError, match=message) as caught:
        read_record(raw)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", InfractionKind)
def test_every_list_of_the_leaderboard_is_read(kind: InfractionKind) -> None:
    raw = {**record(), "infractions": {kind.value: ["it happened (5.0% of it)"]}}

    (infraction,) = read_record(raw).episode.infractions

    assert infraction.kind is kind


def test_a_turn_to_the_right_is_clockwise() -> None:
    read = read_recording(recording(steps=3, yaw_degps=8.0, speed_mps=6.0))

    first, second, _ = read.frames(0.05)

    assert (first.x, first.y, first.time_us, second.time_us) == (0.0, 0.0, 0, 50_000)
    assert first.speed_mps == pytest.approx(6.0, rel=1e-3)
    assert second.y < 0.0 < second.x
    assert second.heading < 0.0
    assert second.yaw_rate_radps == pytest.approx(-math.radians(8.0))
    # the centre of the turn lies to the right: v * omega towards it
    assert second.lateral_acceleration_mps2 == pytest.approx(-6.0 * math.radians(8.0))
    assert second.acceleration_mps2 == pytest.approx(0.0, abs=1e-12)
    assert second.route_m == pytest.approx(0.3, rel=1e-3)
    assert second.steering_rad is None


@pytest.mark.parametrize(
    ("every", "duration_s", "interval_s"),
    [
        (1, 40 * 0.5, 0.5),
        (1, 40 * 0.11, 0.1),
        # near no usual interval: the steps are ticks
        (1, 40 * 0.14, 0.05),
        (10, 1000.0, 0.5),
        (10, None, 0.5),
        (90, None, 1.0),
    ],
)
def test_the_rate_follows_from_the_duration_or_from_the_steps(
    every: int, duration_s: float | None, interval_s: float
) -> None:
    read = read_recording(recording(steps=40, every=every))

    assert read.interval_s(duration_s) == interval_s
    assert read_recording(recording(steps=1)).interval_s() == 0.05


def test_degrees_for_radians_and_what_is_right() -> None:
    turn = drive(driven=read_recording(recording()).frames(0.05))

    assert bench2drive.smoothness(turn).value == 0.0
    assert comfort(turn).value == 1.0


def spoilt(part: str, value: object) -> Json:
    raw = recording(steps=4)
    raw["2"][part] = value
    return raw


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        ({}, "no step is recorded"),
        ([], "no step is recorded"),
        ({"begin": {}}, "'begin' is not the number of a step"),
        ({"0": 5}, "step 0: no acceleration"),
        (spoilt("location", [1.0]), "step 2: no location"),
        (spoilt("angular_velocity", None), "step 2: no angular_velocity"),
        (spoilt("acceleration", [0.0, math.nan, 0.0]), "acceleration is not finite"),
        (spoilt("acceleration", [0, 10**400, 0]), "acceleration is not finite"),
        (spoilt("right_vector", ["x", 0, 0]), "right_vector is not made of numbers"),
    ],
)
def test_a_broken_recording_is_one_line(raw: Any, message: str) -> None:
    with pytest.raises(BrokenRecordingError, match=message):
        read_recording(raw)
