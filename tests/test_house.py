"""The project stays within `house.toml`, whose counts only fall."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.tools.files_entered import CALLS
from benchmarks.tools.house import (
    Budget,
    House,
    budget,
    committed_before,
    entered,
    measure,
)

ROOT = Path(__file__).parents[1]
MOST_LINES = 500


@pytest.fixture(scope="module")
def house() -> House:
    return measure()


def test_no_file_has_more_lines_than_a_reader_takes_in() -> None:
    lines = {
        str(file.relative_to(ROOT)): len(file.read_text("utf-8").splitlines())
        for room in ("me2e_compress", "models", "benchmarks", "tests", "docs", ".ci")
        for file in (ROOT / room).rglob("*.py")
    }
    assert {name: n for name, n in lines.items() if n > MOST_LINES} == {}


def test_no_count_is_above_what_was_noted(house: House) -> None:
    noted = budget().today
    pairs = {n: (count, noted.get(n, 0)) for n, count in house.counts().items()}
    assert {n: pair for n, pair in pairs.items() if pair[0] > pair[1]} == {}


def risen(now: Budget, before: str) -> list[str]:
    """List the counts that rose; a room or a call may, where the total falls."""
    if "[today]" not in before:
        return []  # budgets of another form
    then = Budget.parse(before).today
    has_fallen = now.today["total"] < then["total"]
    return [
        f"{name}: {then[name]} became {count}"
        for name, count in now.today.items()
        if name in then and count > then[name]
        if not (has_fallen and (name.startswith("lines.") or name in CALLS))
    ]


def test_no_count_rises_against_the_commit_before() -> None:
    text = (ROOT / "house.toml").read_text("utf-8")
    more = replace(budget(), today={**budget().today, "options": 10_000})
    assert [line.split(":")[0] for line in risen(more, text)] == ["options"]

    before = committed_before()
    if before is None:
        pytest.skip("not a checkout with history")
    assert risen(budget(), before) == []


def test_ceilings_bind_once_the_house_is_rebuilt(house: House) -> None:
    allowed = budget()
    folders = Counter(file.parent for file in (ROOT / "me2e_compress").rglob("*.py"))
    most, limits = allowed.ceilings["files"], allowed.ceilings
    above = [name for name, n in house.counts().items() if n > limits.get(name, 0)]
    above += [str(folder) for folder, files in folders.items() if files > most]
    assert not (allowed.ceilings_bind and above)
    assert house.total > allowed.ceilings["total"] or allowed.ceilings_bind


def test_no_file_imports_itself_through_others_of_its_room(house: House) -> None:
    assert sorted(house.circles) == budget().circles


@pytest.mark.parametrize(
    "call",
    [pytest.param(c, marks=[pytest.mark.slow] * (c != "compress")) for c in CALLS],
)
def test_a_call_enters_no_more_files_and_functions_than_it_may(call: str) -> None:
    files, functions = budget().today[call]
    counted = entered(call)
    assert 0 < counted[0] <= files
    assert 0 < counted[1] <= functions
