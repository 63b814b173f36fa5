import dataclasses
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from me2e_compress.commands.evaluate import EvaluateResult
from me2e_compress.commands.result import Result, json_ready
from me2e_compress.commands.score import ScoreResult, scores_table
from me2e_compress.metrics.bench2drive import ABILITIES
from me2e_compress.metrics.deadlines import (
    charged_deadlines,
    deadlines,
    deadlines_table,
)
from me2e_compress.metrics.episode import (
    ConflictRecord,
    Encounter,
    Ending,
    Episode,
    InferenceRecord,
    Infraction,
    InfractionKind,
)
from me2e_compress.metrics.measure import Measure, percentile, too_few
from me2e_compress.metrics.route_scores import (
    at_fault_collision,
    room_kept,
    smallest_distance,
    smallest_pet,
    smallest_ttc,
    ttc_exposure,
)
from me2e_compress.metrics.route_summary import RouteSummary
from me2e_compress.metrics.scores import score
from tests.metrics.drives import cruise, drive, infraction

CRASH = infraction(InfractionKind.COLLISION_VEHICLE)
SET = [
    drive(route="a", abilities=("Overtaking",), driven=cruise(traffic=5.0)),
    drive(CRASH, route="b", abilities=("Merging",), completion=50.0),
    drive(route="c", abilities=("Merging", "Traffic_Signs")),
    drive(route="d", abilities=("Emergency_Brake",)),
    drive(CRASH, route="e", abilities=("Give_Way",), completion=10.0),
]


def test_means_over_the_routes_that_were_driven() -> None:
    scores = score(SET, expected=220)

    assert scores.driving_score.value == pytest.approx((3 * 100 + 30 + 6) / 5)
    assert scores.success_rate.value == pytest.approx(60.0)
    assert scores.efficiency.value == pytest.approx(200.0)
    assert scores.efficiency.n == 1
    assert scores.abilities.value == pytest.approx((100 + 50 + 100 + 0 + 100) / 5)
    assert [scores.each_ability[name].n for name in ABILITIES] == [1, 2, 1, 1, 1]


def test_an_ability_that_was_not_driven_is_not_zero() -> None:
    scores = score(SET[:2])

    assert scores.abilities.value is None
    assert scores.abilities.measure.reason == (
        "no route for Emergency_Brake, Give_Way, Traffic_Signs was driven"
    )
    assert scores.each_ability["Give_Way"].value is None


def test_json_has_value_low_high_and_n_for_each_score_and_says_a_partial_set() -> None:
    record = json_ready(score(SET))

    for key in ("driving_score", "success_rate", "efficiency", "comfort", "abilities"):
        assert {"value", "low", "high", "n"} <= set(record[key])
    assert set(record["abilities"]["each"]) == set(ABILITIES)
    assert set(record["bench2drive"]) == {"efficiency", "smoothness"}
    counted = {"driven": 5, "expected": 220, "partial": True, "failed": 0}
    assert record["routes"] == counted
    assert not score(SET, expected=5).partial


@pytest.mark.parametrize(
    ("value", "reason"), [(None, ""), (1.0, "why"), (math.nan, "")]
)
def test_a_measure_is_a_finite_value_or_a_reason(
    value: float | None, reason: str
) -> None:
    with pytest.raises(ValueError, match="measure"):
        Measure(value, "%", reason)


def test_the_column_of_units_holds_units_and_the_note_the_reasons() -> None:
    table = scores_table("results", score(SET[:1]))
    at = table.columns.index("unit")

    assert {row[at].text for row in table.rows} == {"%", "ratio", "s", "m"}
    assert "Emergency_Brake, Give_Way, Traffic_Signs (no such route was driven)" in (
        table.note
    )


def test_a_failure_that_ends_a_route_is_said() -> None:
    broken = dataclasses.replace(
        drive(ending=Ending.POLICY_FAILED, route="r2"), failure="ValueError: no"
    )

    result = score((drive(), broken))

    assert result.failures == {"r2": "ValueError: no"}
    assert result.failed.startswith("1 of 2 routes ended because the policy or the")
    assert result.failed.endswith("failed: ValueError: no (r2)")
    assert score((drive(),)).failed == ""


@pytest.mark.parametrize("kind", [EvaluateResult, ScoreResult])
def test_both_commands_warn_of_failures(kind: type[Result]) -> None:
    scores = score((drive(ending=Ending.SIMULATOR_FAILED),))
    if kind is EvaluateResult:
        result: Result = EvaluateResult("mine", Path("out"), scores)
    else:
        result = ScoreResult({"out": scores})

    assert result.status == "warning"
    assert "simulator failed (r1)" in result.alerts()[0]


def encounter(pet_s: float, angle_deg: float) -> Encounter:
    return Encounter(1, "car", 0, pet_s, math.radians(angle_deg), ego_first=True)


def crash(at_fault: bool | None) -> Infraction:
    result = infraction(InfractionKind.COLLISION_VEHICLE)
    return dataclasses.replace(result, at_fault=at_fault)


NEAR_MISS = drive(
    conflicts=ConflictRecord(
        nearest_m=(9.0, 3.5, None, 4.0),
        ttc_s=(None, 1.5, 1.49, 0.8),
        encounters=(encounter(0.4, 29.0), encounter(2.5, 90.0), encounter(3.0, 31.0)),
    )
)
ALONE = drive(conflicts=ConflictRecord((None,), (None,), ()))


def test_two_of_four_frames_were_a_conflict_and_the_smallest_of_a_route() -> None:
    assert ttc_exposure(NEAR_MISS) == Measure(50.0, "%")
    assert ttc_exposure(ALONE) == Measure(0.0, "%")
    assert smallest_ttc(NEAR_MISS) == Measure(0.8, "s")
    assert smallest_distance(NEAR_MISS) == Measure(3.5, "m")
    assert smallest_pet(NEAR_MISS) == Measure(2.5, "s")
    assert smallest_ttc(ALONE).reason == "no contact was ever within 10 s"
    assert smallest_distance(ALONE).reason == "nobody else was there"
    assert smallest_pet(ALONE).reason == "no paths crossed within 5 s"


def test_room_is_kept_by_who_comes_near_nobody() -> None:
    assert NEAR_MISS.conflicts is not None
    close = dataclasses.replace(
        NEAR_MISS.conflicts, encounters=(encounter(0.3, 60.0), encounter(2.0, 90.0))
    )
    result = [
        room_kept(drive(*faults, conflicts=conflicts)).value
        for faults, conflicts in (
            ((), NEAR_MISS.conflicts),
            ((), close),
            ((crash(False),), close),
            ((crash(True),), close),
            ((), ALONE.conflicts),
        )
    ]

    assert result == pytest.approx([50.0, 10.0, 10.0, 0.0, 100.0])
    for faults in ((), (crash(True),), (crash(None),)):
        episode = drive(*faults, conflicts=close)
        assert RouteSummary.of(episode).room_kept == room_kept(episode).value
    unknown = room_kept(drive(crash(None), conflicts=close))
    assert unknown == Measure(None, "%", "whose fault a collision was is not known")


@pytest.mark.parametrize(
    "measure", [room_kept, ttc_exposure, smallest_ttc, smallest_distance, smallest_pet]
)
def test_what_was_not_recorded_is_not_measured(
    measure: Callable[[Episode], Measure],
) -> None:
    assert measure(drive()).reason == "nobody recorded the distances to others"


@pytest.mark.parametrize(
    ("faults", "answer"),
    [((), False), ((False,), False), ((None,), None), ((None, True), True)],
)
def test_whether_a_collision_was_the_egos_fault(
    faults: tuple[bool | None, ...], answer: bool | None
) -> None:
    assert at_fault_collision(drive(*map(crash, faults))) is answer


def test_the_rate_of_collisions_at_fault_and_none_of_one_unknown_fault() -> None:
    result = score([drive(), drive(crash(False)), drive(crash(True)), drive()]).safety
    unknown = score([drive(), drive(crash(None))]).safety

    assert result.at_fault_collisions.value == 25.0
    assert result.at_fault_collisions.n == 4
    reason = "whose fault 1 collisions were is not known"
    assert unknown.at_fault_collisions.measure == Measure(None, "%", reason)


def test_percentiles_and_the_share_over_budget() -> None:
    result = deadlines([1_000 * ms for ms in range(1, 1001)], 50.0)

    assert result.to_json() == {
        "budget_ms": 50.0,
        "decisions": 1000,
        "p50_ms": 500.0,
        "p99_ms": 990.0,
        "p99.9_ms": 999.0,
        "mean_ms": 500.5,
        "max_ms": 1000.0,
        "over_budget_percent": 95.0,
    }
    assert deadlines([50_000, 50_001]).measures["over_budget_percent"].value == 50.0
    nothing = deadlines([])
    assert (nothing.count, nothing.measures["max_ms"].value) == (0, None)
    assert set(nothing.to_json().values()) == {50.0, 0, None}


def test_a_percentile_of_too_few_or_of_a_trace_of_fewer_is_not_measured() -> None:
    result = deadlines([40_000] * 150)

    assert result.measures["p99_ms"].value == 40.0
    assert result.measures["p99.9_ms"].reason == "needs 1,000 samples, has 150"
    shown = deadlines_table("trace", result)
    assert [cell.text for cell in shown.rows[2]][:2] == ["p99.9", "-"]
    assert "needs 1,000 samples, has 150" in shown.note
    result = deadlines([40_000] * 2478, measured=16)  # drawn from a trace
    assert (result.count, result.measures["p50_ms"].value) == (2478, 40.0)
    for name, needs in (("p99_ms", "100"), ("p99.9_ms", "1,000")):
        reason = result.measures[name].reason
        assert reason == f"needs {needs} samples, has 16"


@pytest.mark.parametrize(("percent", "least"), [(50, 2), (90, 10), (99, 100)])
def test_one_sample_lies_beyond_a_percentile(percent: int, least: int) -> None:
    assert too_few(percent, least - 1)
    assert not too_few(percent, least)
    assert percentile(range(least), percent) == least - 2


def test_latencies_of_all_episodes_are_compared_unless_they_cost_nothing() -> None:
    taken = tuple(InferenceRecord(0, latency_us) for latency_us in (10, 20))
    episode = replace(drive(), decisions=taken)

    result = charged_deadlines([episode, episode])

    assert result is not None
    assert result.count == 4
    free = replace(drive(), decisions=(InferenceRecord(0, 0),))
    assert charged_deadlines([free]) is None  # decisions that cost nothing
