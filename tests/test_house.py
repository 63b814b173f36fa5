"""The package stays within the budgets of ``house.toml``."""

from pathlib import Path

import pytest

from benchmarks.files_entered import CALLS
from benchmarks.house import House, budget, entered, measure

ROOT = Path(__file__).parents[1]
MOST_LINES = 500


@pytest.fixture(scope="module")
def house() -> House:
    return measure()


@pytest.mark.parametrize(
    "room", ["me2e_compress", "driver", "benchmarks", "tests", "docs", ".ci"]
)
def test_no_file_has_more_lines_than_a_reader_takes_in(room: str) -> None:
    lines = {
        str(file.relative_to(ROOT)): len(file.read_text("utf-8").splitlines())
        for file in (ROOT / room).rglob("*.py")
    }
    assert lines
    assert {name: n for name, n in lines.items() if n > MOST_LINES} == {}


def test_no_room_holds_more_lines_than_it_may(house: House) -> None:
    allowed = budget()["lines"]
    above = {
        room: f"{count} lines, {allowed.get(room, 0)} are allowed"
        for room, count in house.lines.items()
        if count > allowed.get(room, 0)
    }
    assert above == {}


def test_all_rooms_together_hold_no_more_lines_than_they_may(house: House) -> None:
    assert house.total <= budget()["total"]


def test_there_are_no_more_options_than_there_may_be(house: House) -> None:
    assert 0 < house.options <= budget()["options"]


def test_no_file_imports_itself_through_others_of_its_room(house: House) -> None:
    assert sorted(house.circles) == budget()["kept"]["circles"]


@pytest.mark.parametrize(
    "call",
    [
        each if each == "compress" else pytest.param(each, marks=pytest.mark.slow)
        for each in CALLS
    ],
)
def test_a_call_enters_no_more_files_and_functions_than_it_may(call: str) -> None:
    files, functions = budget()["entered"][call]
    found = entered(call)
    assert 0 < found[0] <= files
    assert 0 < found[1] <= functions


def test_a_budget_for_a_room_that_is_not_there_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "house.toml"
    path.write_text("total = 1\n[lines]\npasses = 1\nattic = 2\n")

    with pytest.raises(ValueError, match=r"house.toml: no room attic"):
        budget(path)
