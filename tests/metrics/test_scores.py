import dataclasses
import math
from pathlib import Path

import pytest

from me2e_compress.metrics.bench2drive import ABILITIES
from me2e_compress.metrics.episode import Ending, InfractionKind
from me2e_compress.metrics.measure import Measure
from me2e_compress.metrics.scores import score
from me2e_compress.workflows.evaluate import EvaluateResult
from me2e_compress.workflows.result import Result
from me2e_compress.workflows.score import ScoreResult, scores_table
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


def test_a_partial_set_is_said_so_and_never_divided_by_220() -> None:
    scores = score(SET)

    assert scores.partial
    assert scores.to_json()["routes"] == {
        "driven": 5,
        "expected": 220,
        "partial": True,
        "failed": 0,
    }
    assert not score(SET, expected=5).partial


def test_an_ability_that_was_not_driven_is_not_zero() -> None:
    scores = score(SET[:2])

    assert scores.abilities.value is None
    assert scores.abilities.measure.reason == (
        "no route for Emergency_Brake, Give_Way, Traffic_Signs was driven"
    )
    assert scores.each_ability["Give_Way"].value is None


def test_json_has_value_low_high_and_n_for_each_score() -> None:
    record = score(SET).to_json()

    for key in ("driving_score", "success_rate", "efficiency", "comfort", "abilities"):
        assert {"value", "low", "high", "n"} <= set(record[key])
    assert set(record["abilities"]["each"]) == set(ABILITIES)
    assert set(record["bench2drive"]) == {"efficiency", "smoothness"}


def test_the_order_of_the_routes_changes_no_mean_and_without_any_there_is_none() -> (
    None
):
    forward, backward = score(SET), score(SET[::-1])

    assert score([]).driving_score.measure == Measure(None, "%", "no route was driven")
    assert forward.driving_score.value == backward.driving_score.value
    assert forward.success_rate.value == backward.success_rate.value


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

    found = score((drive(), broken))

    assert found.failures == {"r2": "ValueError: no"}
    assert found.failed.startswith("1 of 2 routes ended because the policy or the")
    assert found.failed.endswith("failed: ValueError: no (r2)")
    assert score((drive(),)).failed == ""


@pytest.mark.parametrize("kind", [EvaluateResult, ScoreResult])
def test_both_commands_warn_of_failures(kind: type[Result]) -> None:
    scores = score((drive(ending=Ending.SIMULATOR_FAILED),))
    if kind is EvaluateResult:
        found: Result = EvaluateResult("mine", Path("out"), scores)
    else:
        found = ScoreResult({"out": scores})

    assert found.status == "warning"
    assert "simulator failed (r1)" in found.alerts()[0]
