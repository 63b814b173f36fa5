"""The log of training, options compared by name, and the folder that is theirs."""

from pathlib import Path
from typing import Any

import pytest

from models.driver.errors import TrainingError
from models.driver.log import Log
from models.driver.options import claim, difference


@pytest.fixture
def log(tmp_path: Path) -> Log:
    log = Log(tmp_path / "log.jsonl")
    for step in (2, 4, 6):
        log.add("losses", step, {"plan_m": float(step)})
    return log


def test_a_log_that_is_not_there_is_empty(tmp_path: Path) -> None:
    assert Log(tmp_path / "log.jsonl").rows() == []


def test_rows_are_in_order(log: Log) -> None:
    assert [row["step"] for row in log.rows()] == [2, 4, 6]
    assert log.rows()[0] == {"what": "losses", "step": 2, "plan_m": 2.0}


def test_nothing_is_told_twice(log: Log) -> None:
    log.add("losses", 6, {"plan_m": 7.0})
    assert [row["plan_m"] for row in log.rows()] == [2, 4, 7]


def test_another_kind_of_row_is_another_row(log: Log) -> None:
    log.add("closed_loop", 6, {})
    assert [row["what"] for row in log.rows()] == [*["losses"] * 3, "closed_loop"]


def test_what_is_done_again_is_forgotten(log: Log) -> None:
    log.rewind(4)
    assert [row["step"] for row in log.rows()] == [2, 4]


def test_a_file_that_is_no_log_is_named(tmp_path: Path) -> None:
    (tmp_path / "log.jsonl").write_text("step 3\n")
    with pytest.raises(TrainingError, match=r"log\.jsonl: not a log: "):
        Log(tmp_path / "log.jsonl").rows()


OPTIONS: dict[str, Any] = {
    "rate": 0.1,
    "strides": [1, 2],
    "rounds": [{"seed": 1, "how": {"light": 0.5}}, {"seed": 2, "how": {"light": 0.5}}],
}


def test_equal_options_do_not_differ() -> None:
    assert difference(OPTIONS, {**OPTIONS, "strides": (1, 2)}) is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rate": 0.2}, ("rate", "0.1", "0.2")),
        ({"strides": (1, 3)}, ("strides", "[1, 2]", "[1, 3]")),
        ({"rounds": []}, ("rounds", "missing", "[]")),
        (
            {"rounds": [OPTIONS["rounds"][0], {"seed": 3, "how": {"light": 0.5}}]},
            ("rounds.1.seed", "2", "3"),
        ),
        (
            {"rounds": [{"seed": 1, "how": {"light": 0.6}}, OPTIONS["rounds"][1]]},
            ("rounds.0.how.light", "0.5", "0.6"),
        ),
        ({"more": None}, ("more", "missing", "null")),
    ],
)
def test_the_first_difference_has_a_name(
    change: dict[str, Any], words: tuple[str, str, str]
) -> None:
    assert difference(OPTIONS, {**OPTIONS, **change}) == words


def test_what_may_change_does_not_matter() -> None:
    assert difference(OPTIONS, {**OPTIONS, "rate": 1.0}, but=("rate",)) is None


def test_a_folder_is_claimed_once_and_a_draft_of_a_kill_does_not_matter(
    tmp_path: Path,
) -> None:
    (tmp_path / ".a.json.x1").write_text("{")
    claim(tmp_path / "a.json", "course", OPTIONS)
    before = (tmp_path / "a.json").read_bytes()
    claim(tmp_path / "a.json", "course", OPTIONS)
    assert (tmp_path / "a.json").read_bytes() == before
    words = r"holds another course: its rounds\.1\.seed is 2, this one's 3; choose"
    rounds = [OPTIONS["rounds"][0], {"seed": 3, "how": {"light": 0.5}}]
    with pytest.raises(TrainingError, match=words):
        claim(tmp_path / "a.json", "course", {**OPTIONS, "rounds": rounds})


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("thesis.tex", "years of work", r"not empty, and holds no a\.json"),
        ("a.json", "{", r"a\.json: not JSON"),
        ("a.json", "1", r"a\.json: not a course"),
    ],
)
def test_a_folder_of_something_else_is_refused(
    tmp_path: Path, name: str, content: str, words: str
) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(TrainingError, match=words):
        claim(tmp_path / "a.json", "course", OPTIONS)
