"""Records of finished drives: what they keep, and which are not taken."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from me2e_compress.errors import StudyError
from me2e_compress.metrics.route_summary import RouteSummary
from me2e_compress.study import Condition, Study, StudyResult
from me2e_compress.study.drive_record import DriveRecord, changes, held_against
from me2e_compress.study.study_result import change_tables
from tests.study.conftest import IDEAL, ROUTES, Make


@pytest.fixture
def record(found: StudyResult) -> Path:
    """The record of one drive."""
    folder = found.contrasts[0].picture.parents[1]
    return folder / "records" / "blind.slow.jsonl"


def test_a_record_keeps_what_the_tables_need(record: Path) -> None:
    read = DriveRecord.load(record)

    assert [each.route for each in read.routes] == [each.id for each in ROUTES]
    assert read.routes[0].latency_us == (500_000,) * 4
    assert read.made_by["set_size"] == 220
    assert record.stat().st_size < 2_000


def test_a_record_is_read_as_it_was_written(record: Path, tmp_path: Path) -> None:
    read = DriveRecord.load(record)
    read.save(tmp_path / "again.jsonl")

    assert (tmp_path / "again.jsonl").read_bytes() == record.read_bytes()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda text: text[: len(text) // 2], "its last line was cut off"),
        (lambda text: text + text.splitlines()[-1] + "\n", "names route .* twice"),
        (lambda text: text.replace("completion", "finish"), "not a record of a drive"),
        (lambda text: "", "its last line was cut off"),
    ],
)
def test_a_spoilt_record_is_named(
    record: Path, tmp_path: Path, spoil: object, message: str
) -> None:
    path = tmp_path / "blind.slow.jsonl"
    path.write_text(spoil(record.read_text()))  # type: ignore[operator]

    with pytest.raises(StudyError, match=rf"^{path}: .*{message}"):
        DriveRecord.load(path)


FOG = Condition("fog", "none", against="ideal")
CONDITIONS = (IDEAL, FOG)


def summary(route: str, scenario: str, score: float) -> RouteSummary:
    ended = (100.0, score == 100.0, "", (), None, None)
    made = RouteSummary(route, scenario, score, *ended, 1, 0, (), 0)
    return replace(made, ttc_exposure=(100.0 - score) / 2, at_fault=False)


def drive(variant: str, condition: str, scores: Sequence[float]) -> DriveRecord:
    routes = tuple(
        summary(f"r{n}", f"type{n // 2}", score) for n, score in enumerate(scores)
    )
    return DriveRecord(variant, condition, routes)


DRIVES = (
    drive("float", "ideal", [100, 100, 100, 60]),
    drive("int8", "ideal", [100, 100, 80, 60]),
    drive("float", "fog", [100, 90, 100, 60]),
    drive("int8", "fog", [60, 90, 80, 20]),
)


def test_a_change_is_held_against_the_same_routes_without_it() -> None:
    float_, int8 = changes(CONDITIONS, DRIVES, "float", 0)

    assert (float_.drive, float_.against) == ("float.fog", "float.ideal")
    assert float_.driving_score.value == pytest.approx(-2.5)
    assert float_.success_rate.value == pytest.approx(-25.0)
    assert float_.room_kept.value == pytest.approx(-2.5 / 2)
    assert float_.beyond == {}
    assert int8.driving_score.value == pytest.approx((-40 - 10 - 40) / 4)


def test_int8_loses_more_is_a_difference_of_differences() -> None:
    _, int8 = changes(CONDITIONS, DRIVES, "float", 0)

    found = int8.beyond["driving_score"]
    assert found.value == pytest.approx((-40 + 0 + 0 - 40) / 4)
    assert found.low is not None
    assert found.high is not None
    assert found.low < -20.0 < found.high
    assert found.n == 4
    assert int8.beyond["room_kept"].value == pytest.approx(-10.0)


def test_what_was_not_driven_is_left_out() -> None:
    missing = DriveRecord("int8", "fog", reason="it failed")

    assert len(changes(CONDITIONS, (*DRIVES[:3], missing), "float", 0)) == 1
    assert held_against([("int8.fog", "float.ideal")], DRIVES[:3], 0) == ()


def test_a_pair_crosses_variants_and_conditions() -> None:
    [pair] = held_against([("int8.fog", "float.ideal")], DRIVES, 0)

    assert pair.driving_score.value == pytest.approx((-40 - 10 - 20 - 40) / 4)
    assert pair.to_json()["beyond_baseline"]["driving_score"] is None


def test_tables_of_changes_and_pairs(make: Make) -> None:
    class Outcome:
        """A study's outcome, so far as these tables read it."""

        study: Study = make(conditions=(IDEAL, FOG), baseline="slow")
        changes = changes(CONDITIONS, DRIVES, "float", 0)
        pairs = held_against([("int8.fog", "float.ideal")], DRIVES, 0)

    one, other = change_tables(Outcome())  # type: ignore[arg-type]

    assert one.columns[-3:] == ("DS beyond", "room beyond", "SR beyond")
    assert [len(row) for row in one.rows] == [9, 9]
    assert one.rows[0][6].reason == "the baseline itself"
    assert [len(row) for row in other.rows] == [6]
