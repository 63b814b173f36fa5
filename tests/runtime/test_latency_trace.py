"""A trace shows no percentile that it has too few samples for."""

import pytest

from me2e_compress.runtime.latency_trace import LatencyTrace, shares

WHY = "Not measured: p99 (needs 100 samples, has 16)."


def trace_of(count: int) -> LatencyTrace:
    taken = tuple(range(1, count + 1))
    return LatencyTrace("0", "a CPU", taken, modules_us={"planner": taken})


@pytest.mark.parametrize(("count", "p99"), [(8, None), (99, None), (100, 99)])
def test_p99_needs_100_samples(count: int, p99: int | None) -> None:
    found = trace_of(count)

    assert found.to_json()["p99_us"] == p99
    (module,) = shares(found.modules_us)
    assert module.p99_us == p99


def test_what_is_not_told_is_a_dash_with_its_reason() -> None:
    whole, modules = trace_of(16).tables()

    assert [cell.text for cell in whole.rows[2]] == ["p99", "-"]
    assert modules.rows[0][4].text == "-"
    assert whole.note == modules.note == WHY
    assert trace_of(100).tables()[0].note == ""
