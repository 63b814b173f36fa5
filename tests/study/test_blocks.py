"""Some variants under some conditions, and what is left to drive of them."""

from dataclasses import replace
from pathlib import Path

import pytest

from me2e_compress.errors import StudyError
from me2e_compress.study import Condition, Study, run_study
from me2e_compress.study.definition import FramesToRecord, StudyBlock
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.workload import held_frames, workload
from tests.study.conftest import BLIND, FASTER, IDEAL, ROUTES, SLOW, Here

ASKED = Study(
    "Asked again",
    (BLIND, FASTER),
    (IDEAL, SLOW),
    "blind",
    ROUTES,
    220,
    blocks=(
        StudyBlock("table-2", ("blind",), ("ideal", "slow")),
        StudyBlock("table-3", ("blind", "faster"), ("ideal",)),
    ),
)


def test_a_block_drives_its_variants_and_the_rest_is_left(tmp_path: Path) -> None:
    before, engine = workload(ASKED, tmp_path, 2), Here()

    run_study(ASKED, tmp_path, engine, pictures=0)

    drives = [(each.variant, each.condition) for each in before.drives]
    assert drives == [("blind", "ideal"), ("faster", "ideal"), ("blind", "slow")]
    assert before.headline.startswith("Asked again: 3 drives, 6 routes, 0 of them driv")
    assert before.drives[0].hours > before.drives[-1].hours > 0.0
    assert len(engine.driven) == 3 * len(ROUTES)
    assert [each.done for each in workload(ASKED, tmp_path, 2).drives] == [2, 2, 2]


def test_the_blocks_of_a_study_can_be_chosen() -> None:
    part = ASKED.of_blocks(["table-2"])

    assert [each.name for each in part.variants] == ["blind"]
    assert [each.name for each in part.conditions] == ["ideal", "slow"]
    with pytest.raises(StudyError, match=r"^no block 4; there are table-2, table-3$"):
        ASKED.of_blocks(["4"])


def test_what_a_block_or_a_recording_cannot_be() -> None:
    with pytest.raises(StudyError, match="block table-9: no variant gone; there are b"):
        replace(ASKED, blocks=(StudyBlock("table-9", ("gone",), ("ideal",)),))
    with pytest.raises(StudyError, match="block a: there is nothing to drive"):
        StudyBlock("a", (), ("ideal",))
    with pytest.raises(StudyError, match="record: 0 frames and 4 held out"):
        FramesToRecord(0, 4)


def test_the_mean_of_a_drive_is_that_of_its_record(tmp_path: Path) -> None:
    even = Condition("even", mean_of="faster.slow")
    asked = replace(
        ASKED,
        conditions=(SLOW, even),
        routes=ROUTES[:1],
        blocks=(StudyBlock("tail", ("faster",), ("slow", "even")),),
    )

    run_study(asked, tmp_path, Here(), pictures=0)

    record = DriveRecord.load(tmp_path / "records" / "faster.even.jsonl")
    assert record.mean_latency_us == 500_000
    assert held_frames(asked, even) == held_frames(asked, SLOW)
