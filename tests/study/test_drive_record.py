"""Records of finished drives: what they keep, and which are not taken."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from me2e_compress.errors import StudyError
from me2e_compress.study import Variant
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.paper.paper_result import PaperResult
from me2e_compress.study.paper.paper_run import read_paper
from tests.study.conftest import ASKED, BLIND, BROKEN, ROUTES, Here, run_paper


def test_a_record_of_another_evaluation_is_not_taken(driven: Path) -> None:
    other = replace(ASKED, variants=(BLIND, Variant("faster", "blind:7"), BROKEN))

    found = run_paper(other, driven, Here())

    assert (
        "of another evaluation: its policy is" in found.drive("faster", "ideal").reason
    )


def test_a_record_keeps_what_the_tables_need(driven: Path) -> None:
    path = driven / "records" / "blind.slow.jsonl"
    record = DriveRecord.load(path)

    assert [each.route for each in record.routes] == [each.id for each in ROUTES]
    assert record.routes[0].latency_us == (500_000,) * 4
    assert path.stat().st_size < 2_000


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
    driven: Path, tmp_path: Path, spoil: object, message: str
) -> None:
    text = (driven / "records" / "blind.slow.jsonl").read_text()
    path = tmp_path / "blind.slow.jsonl"
    path.write_text(spoil(text))  # type: ignore[operator]

    with pytest.raises(StudyError, match=rf"^{path}: .*{message}"):
        DriveRecord.load(path)


def test_records_of_other_routes_do_not_stand_together(
    driven: Path, tmp_path: Path
) -> None:
    for path in (driven / "records").iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    path = tmp_path / "faster.ideal.jsonl"
    head, *rows = path.read_text().splitlines()
    made = json.loads(head)
    made["made_by"]["routes_sha256"] = "0"
    path.write_text("\n".join([json.dumps(made), *rows]) + "\n")

    with pytest.raises(StudyError, match="drives of different sets of routes"):
        read_paper(ASKED, tmp_path)


def test_a_record_is_read_as_it_was_written(
    result: PaperResult, tmp_path: Path
) -> None:
    record = result.drive("minus-map", "device")
    path = tmp_path / "one.jsonl"
    record.save(path)

    assert DriveRecord.load(path) == record
