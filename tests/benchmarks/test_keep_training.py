import filecmp
from pathlib import Path

import pytest

from benchmarks.keep_training import KEPT, keep, with_rows

HEAD = (
    "scheme,condition,route,driving_score_percent,succeeded,ending,infractions,"
    "room_kept_percent\n"
)


def row(scheme: str, score: float) -> str:
    return f"{scheme},five,Accident_R2_0,{score},1,completed,,100.0\n"


def test_what_is_kept_of_a_training_is_enough_to_keep_it_again(tmp_path: Path) -> None:
    assert keep(KEPT / "seed-0", tmp_path) == "seed-0"

    files = [path for path in (KEPT / "seed-0").rglob("*") if path.is_file()]
    assert len(files) == 12
    for path in files:
        assert filecmp.cmp(path, tmp_path / path.relative_to(KEPT), shallow=False)


def test_a_drive_takes_the_place_of_its_rows_and_no_others() -> None:
    old = HEAD + row("shipped", 1) + row("seed-1-round-0", 2) + row("seed-1-round-1", 3)
    fresh = HEAD + row("seed-1-round-1", 4) + row("seed-0-round-0", 5)

    assert with_rows(old, fresh) == HEAD + row("shipped", 1) + row(
        "seed-0-round-0", 5
    ) + row("seed-1-round-0", 2) + row("seed-1-round-1", 4)


def test_a_folder_without_a_course_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"course\.json"):
        keep(tmp_path, tmp_path)
