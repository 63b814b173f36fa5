"""The paper's study on drivers that need no images."""

import hashlib
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from me2e_compress.errors import StudyError
from me2e_compress.simulator.routes import SETS, load_routes
from me2e_compress.study import Condition, Listener, Study, StudyResult, Timing, Variant
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.paper.accident import Accident, plans_before
from me2e_compress.study.paper.evidence import FEWEST_RUNS
from me2e_compress.study.paper.paper_run import read_paper
from me2e_compress.study.paper.questions import SHIPPED
from me2e_compress.study.study_blocks import FramesToRecord, StudyBlock
from me2e_compress.study.workload import held_frames, workload
from tests.study.conftest import (
    ASKED,
    BLIND,
    FASTER,
    IDEAL,
    ROUTES,
    SLOW,
    First,
    Here,
    run_paper,
)


def test_a_block_drives_what_no_other_has_driven(first: First) -> None:
    assert first.landed == [2, 3]
    assert len(first.engine.driven) == 3 * len(ROUTES)


def test_a_variant_that_fails_leaves_the_others(driven: Path) -> None:
    warned = list[str]()
    listener = Listener(lambda *_: None, warned.append)

    found = run_paper(ASKED, driven, Here(), listener)

    names = {each.name for each in found.finished}
    assert names == {"blind.ideal", "blind.slow", "faster.ideal"}
    why = "variant broken: gone.onnx: no such model"
    assert found.drive("broken", "ideal").reason == why
    assert warned[0] == f"variant broken is left out: {why}"
    assert found.alerts() == (f"broken under ideal was left out: {why}",)


def test_a_finished_cell_needs_no_frames_and_lands_nothing(driven: Path) -> None:
    engine, landed = Here(), list[StudyResult]()
    before = run_paper(ASKED, driven, engine)
    for path in (driven / "results").glob("*/routes/*.json"):
        path.unlink()

    assert run_paper(ASKED, driven, engine, on_block=landed.append) == before
    assert (engine.driven, landed) == ([], [])


def test_tables_follow_from_the_records_alone(driven: Path) -> None:
    run = run_paper(ASKED, driven, Here())

    read = read_paper(ASKED, driven / "records")

    assert read.tables() == run.tables()
    assert read.machine == run.machine
    assert read.lines() == run.lines()
    assert "they were asked before these drives" in run.lines()[1]


ONE = """interval = "types"
correction = "holm"
alpha = 0.05
step = 2.0
[[question]]
name = "rate"
asks = "Slow is worse"
paper = "it was"
of = "blind.slow"
minus = "blind.ideal"
holds = "below"
"""


@pytest.mark.parametrize(
    ("change", "asked"),
    [
        (lambda text: text, "before its drives"),
        (lambda text: text.replace("[[", "# a comment\n[["), "before its drives"),
        (lambda text: text.replace("below", "above"), "changed after its drives"),
        (lambda text: text.replace("0.05", "0.5"), "changed after its drives"),
        (lambda text: text.replace('"rate"', '"r"'), "added after seeing results"),
    ],
)
def test_questions_that_changed_after_their_drives_are_named(
    driven: Path, tmp_path: Path, change: Callable[[str], str], asked: str
) -> None:
    # the records of a folder whose drives were made for these questions
    file, records = tmp_path / "asked.toml", tmp_path / "records"
    shutil.copytree(driven / "records", records)
    (records / "questions.toml").write_text(ONE)
    digest = hashlib.sha256(ONE.encode()).hexdigest()
    for path in records.glob("*.jsonl"):
        replace(DriveRecord.load(path), questions=digest).save(path)
    file.write_text(change(ONE))

    found = read_paper(replace(ASKED, questions=file), records)

    assert found.findings[0].asked == asked
    told = found.lines()[1]
    assert ("they were asked before these drives" in told) == (file.read_text() == ONE)
    if asked != "before its drives":
        name = found.findings[0].question.name
        assert told.endswith(
            f"changed after drives that were made for {digest}: {name}."
        )
        assert told in found.tables()[0].note


def test_a_drive_knows_its_questions_unless_they_came_later(
    driven: Path, tmp_path: Path
) -> None:
    name = Path("records", "faster.ideal.jsonl")
    asked = hashlib.sha256(SHIPPED.read_bytes()).hexdigest()
    assert DriveRecord.load(driven / name).questions == asked
    folder = tmp_path / "without"
    shutil.copytree(driven, folder)
    (folder / "records" / "questions.toml").unlink()
    (folder / name).unlink()

    found = run_paper(ASKED, folder, Here())

    assert DriveRecord.load(folder / name).questions == ""
    assert not (folder / "records" / "questions.toml").exists()
    assert "before its drives" not in {each.asked for each in found.findings}


def test_the_blocks_of_a_study_can_be_chosen() -> None:
    part = ASKED.of_blocks(["2"])

    assert [each.name for each in part.variants] == ["blind"]
    assert [each.name for each in part.conditions] == ["ideal", "slow"]
    with pytest.raises(StudyError, match=r"^no block 4; there are table-2, table-3$"):
        ASKED.of_blocks(["4"])


def test_a_dry_run_counts_what_is_left(driven: Path, tmp_path: Path) -> None:
    ahead, after = workload(ASKED, tmp_path, 2), workload(ASKED, driven, 2)

    drives = [(each.variant, each.condition) for each in ahead.drives]
    assert drives == [
        ("blind", "ideal"),
        ("faster", "ideal"),
        ("broken", "ideal"),
        ("blind", "slow"),
    ]
    assert ahead.headline.startswith("Asked again: 4 drives, 8 routes, 0 of them driv")
    assert ahead.drives[0].hours > ahead.drives[-1].hours > 0.0
    assert [each.done for each in after.drives] == [2, 2, 0, 2]


def test_a_route_of_the_second_road_is_expected_to_take_longer(tmp_path: Path) -> None:
    there = load_routes(SETS[2])[:2]
    here = tuple(replace(each, road=1) for each in there)

    hours = [
        workload(replace(ASKED, routes=routes), tmp_path).hours
        for routes in (here, there)
    ]

    assert hours[1] == pytest.approx(1.5 * hours[0])


def test_what_a_block_or_a_recording_cannot_be() -> None:
    with pytest.raises(StudyError, match="block table-9: no variant gone; there are b"):
        replace(ASKED, blocks=(StudyBlock("table-9", ("gone",), ("ideal",)),))
    with pytest.raises(StudyError, match="block a: there is nothing to drive"):
        StudyBlock("a", (), ("ideal",))
    with pytest.raises(StudyError, match="record: 0 frames and 4 held out"):
        FramesToRecord(0, 4)


def test_other_stacks_are_counted_beside_records(
    driven: Path, models: Path, tmp_path: Path
) -> None:
    stacks = [tmp_path / "one", tmp_path / "two"]
    for each in stacks:
        each.mkdir()
        (each / "exact.onnx").write_bytes((models / "slow.onnx").read_bytes())

    found = read_paper(ASKED, driven / "records", stacks)

    assert [each.variant for each in found.facts][-2:] == ["one exact", "two exact"]


def test_models_are_timed_and_weighed(models: Path, tmp_path: Path) -> None:
    slow = Variant("slow", str(models / "slow.onnx"))
    study = Study(
        "Timed",
        (slow,),
        (IDEAL, Condition("device", "trace")),
        "slow",
        ROUTES[:1],
        220,
        held_out=models / "frames",
        timing=Timing(10, baseline_median_s=0.2),
        report="paper",
        blocks=(StudyBlock("table-3", ("slow",), ("device",)),),
    )

    found = run_paper(study, tmp_path, Here())

    [fact] = found.facts
    assert len(fact.latency_us) == 10
    assert len(fact.runs_us) == FEWEST_RUNS
    assert all(100_000 < each < 400_000 for each in fact.runs_us)
    assert min(fact.latency_us) <= 200_001 <= max(fact.latency_us) + 2
    assert fact.parameters is not None
    assert sum(map(len, fact.modules_us.values())) > 0
    assert found.study.preview == " (preview: 1 of 220 routes)"
    assert all("preview" in table.title for table in found.tables())


def test_the_mean_of_a_drive_that_a_later_block_has(tmp_path: Path) -> None:
    even = Condition("even", mean_of="faster.slow")
    asked = replace(
        ASKED,
        conditions=(SLOW, even),
        variants=(BLIND, FASTER),
        routes=ROUTES[:1],
        blocks=(
            StudyBlock("table-2", ("blind",), ("slow",)),
            StudyBlock("tail", ("faster",), ("slow", "even")),
        ),
    )

    found = run_paper(asked, tmp_path, Here())

    assert not found.alerts()
    assert found.drive("faster", "even").mean_latency_us == 500_000
    assert held_frames(asked, even) == held_frames(asked, SLOW)


def test_an_accident_keeps_its_last_seconds(driven: Path, tmp_path: Path) -> None:
    accident = run_paper(ASKED, driven, Here()).accident

    assert accident is not None
    assert (accident.variant, accident.condition) == ("blind", "ideal")
    times = [each.time_us for each in accident.moments]
    assert times == list(range(times[0], times[-1] + 1, 500_000))
    last = accident.moments[-1]
    ahead = math.dist(last.plan[0], (last.ego.x, last.ego.y))
    assert ahead == pytest.approx(3.0, abs=0.5)  # half a second at 6 m/s
    assert last.others
    assert read_paper(ASKED, driven / "records").accident == accident
    assert plans_before(accident).axes[0].lines
    (tmp_path / "cut.json").write_text("{}")
    with pytest.raises(StudyError, match="not an accident"):
        Accident.load(tmp_path / "cut.json")
