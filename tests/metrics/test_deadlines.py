from dataclasses import replace

import pytest

from me2e_compress.errors import EvaluationError
from me2e_compress.metrics.deadlines import charged, deadlines, deadlines_table
from me2e_compress.metrics.episode import ConflictRecord, InferenceRecord
from me2e_compress.metrics.measure import percentile, too_few
from me2e_compress.workflows.options import check_budget
from tests.metrics.drives import drive


def test_percentiles_and_the_share_over_budget() -> None:
    found = deadlines([1_000 * ms for ms in range(1, 1001)], 50.0)

    assert found.to_json() == {
        "budget_ms": 50.0,
        "decisions": 1000,
        "p50_ms": 500.0,
        "p99_ms": 990.0,
        "p99.9_ms": 999.0,
        "mean_ms": 500.5,
        "max_ms": 1000.0,
        "over_budget_percent": 95.0,
        "critical_mean_ms": None,
        "other_mean_ms": None,
    }


def test_exactly_the_budget_is_in_time() -> None:
    assert deadlines([50_000, 50_001]).over_percent.value == 50.0


def test_a_percentile_of_too_few_is_not_measured() -> None:
    found = deadlines([40_000] * 150)

    assert found.percentiles_ms[99.0].value == 40.0
    assert found.percentiles_ms[99.9].reason == "needs 1,000 samples, has 150"
    shown = deadlines_table("trace", found)
    assert [cell.text for cell in shown.rows[2]][:2] == ["p99.9", "-"]
    assert "needs 1,000 samples, has 150" in shown.note


def test_decisions_drawn_from_a_trace_tell_no_more_than_it() -> None:
    found = deadlines([40_000] * 2478, measured=16)

    assert found.count == 2478
    assert found.percentiles_ms[50.0].value == 40.0
    assert found.percentiles_ms[99.0].reason == "needs 100 samples, has 16"
    assert found.percentiles_ms[99.9].reason == "needs 1,000 samples, has 16"


@pytest.mark.parametrize(("percent", "least"), [(50, 2), (90, 10), (99, 100)])
def test_one_sample_lies_beyond_a_percentile(percent: int, least: int) -> None:
    assert too_few(percent, least - 1)
    assert not too_few(percent, least)
    assert percentile(range(least), percent) == least - 2


def test_nothing_decided_is_not_zero() -> None:
    found = deadlines([])

    assert found.count == 0
    assert found.over_percent.value is None
    assert set(found.to_json().values()) == {50.0, 0, None}


@pytest.mark.parametrize("budget_ms", [0.0, -1.0, float("nan"), float("inf")])
def test_a_budget_is_positive(budget_ms: float) -> None:
    with pytest.raises(EvaluationError, match="--budget-ms"):
        check_budget(budget_ms)


def test_a_tail_in_critical_frames_shows() -> None:
    looked = ConflictRecord((None,) * 4, (None, 1.4, 1.5, 0.2), ())
    taken = [(0, 100_000), (50_000, 250_000), (100_000, 100_000), (150_000, 350_000)]
    episode = replace(
        drive(conflicts=looked),
        decisions=tuple(InferenceRecord(*each) for each in taken),
    )

    found = charged([episode, replace(episode, conflicts=None)])

    assert found is not None
    assert found.count == 8
    assert found.critical_ms.value == 300.0
    assert found.other_ms.value == 100.0
    assert [row[0].text for row in deadlines_table("r", found).rows][-2:] == [
        "mean, TTC below 1.5 s",
        "mean, other frames",
    ]


def test_decisions_that_cost_nothing_have_no_deadlines() -> None:
    free = replace(drive(), decisions=(InferenceRecord(0, 0),))

    assert charged([free]) is None
