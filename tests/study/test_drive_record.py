"""Records of finished drives: what they keep, and which are not taken."""

from pathlib import Path

import pytest

from me2e_compress.errors import StudyError
from me2e_compress.study import StudyResult
from me2e_compress.study.drive_record import DriveRecord
from tests.study.conftest import ROUTES


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
