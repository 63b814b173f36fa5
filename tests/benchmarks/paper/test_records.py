"""The pages that are kept, and facts of a study that was driven."""

import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.paper import weigh
from benchmarks.paper.__main__ import NOTHING, PAGE
from benchmarks.paper.accident import plans_before
from benchmarks.paper.evidence import FEWEST_RUNS
from benchmarks.paper.records import RECORDS, add_facts, read_paper
from me2e_compress.base.errors import StudyError
from me2e_compress.commands.result import SILENT
from me2e_compress.simulator.routes import Route
from me2e_compress.study import Condition, Study, Timing, Variant, load_study, run_study
from me2e_compress.study.definition import StudyBlock
from tests.benchmarks.paper.made import write_records
from tests.evaluators.highway.drivers import straight_on
from tests.study.conftest import IDEAL
from tests.support.command import write_frames
from tests.support.in_process import Here

CRASHED = Route("crashed", "Accident", 1)

ONE = """interval = "types"
correction = "holm"
alpha = 0.05
step = 2.0
[[question]]
name = "rate"
asks = "Slow is worse"
paper = "it was"
of = "float.ideal"
minus = "float.fps-1"
"""


def test_the_page_is_that_of_the_drives_that_are_kept() -> None:
    text = PAGE.path.read_text("utf-8")

    [asked_at] = re.findall("; questions committed (.*?)\\. All", text)

    assert text == PAGE.text(asked_at)


def test_drives_that_are_kept_make_the_same_tables(tmp_path: Path) -> None:
    page, records, kept = PAGE, tmp_path / "run" / "records", tmp_path / "kept"
    assert page.text("", tmp_path).endswith(NOTHING)
    write_records(load_study(page.study, "5").of_blocks(["table-6"]), records)
    text = page.text("", records)
    names = {path.name for path in records.iterdir()}
    (records / "of.another-study.jsonl").touch()

    replace(page, kept=kept).keep(records)

    assert {path.name for path in kept.iterdir()} == {*names, "traces"}
    assert page.text("", kept) == text
    assert "preview: 5 of 220 routes" in text


@pytest.mark.parametrize(
    ("old", "new", "asked"),
    [
        ("[[", "# a comment\n[[", "before its drives"),
        ("0.05", "0.5", "changed after its drives"),
        ('"rate"', '"r"', "added after seeing results"),
    ],
)
def test_questions_that_changed_after_their_drives_are_named(
    tmp_path: Path, old: str, new: str, asked: str
) -> None:
    study = load_study(PAGE.study, "5").of_blocks(["table-2"])
    write_records(study, tmp_path)
    (tmp_path / "questions.toml").write_text(ONE)
    digest = hashlib.sha256(ONE.encode()).hexdigest()
    for path in tmp_path.glob("*.jsonl"):
        head, rows = path.read_text().split("\n", 1)
        path.write_text(json.dumps({**json.loads(head), "questions": digest}))
        path.write_text(f"{path.read_text()}\n{rows}")
    now = tmp_path / "now.toml"
    now.write_text(ONE.replace(old, new))

    found = read_paper(study, tmp_path, now)

    assert found.findings[0].asked == asked


def test_a_study_that_was_driven_is_weighed_and_its_accident_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(weigh, "PROFILED", 2)
    monkeypatch.setattr(weigh, "RUN_SAMPLES", 2)
    straight_on(tmp_path / "slow.onnx")
    write_frames(tmp_path / "frames", command=np.array([3]))
    study = Study(
        "Timed",
        (Variant("slow", str(tmp_path / "slow.onnx")),),
        (IDEAL, Condition("device", "trace")),
        "slow",
        (CRASHED,),
        220,
        held_out=tmp_path / "frames",
        timing=Timing(10, baseline_median_s=0.2),
        blocks=(StudyBlock("table-3", ("slow",), ("ideal", "device")),),
    )
    out = tmp_path / "out"
    with pytest.raises(StudyError, match="holds no records: drive the study first"):
        add_facts(study, out, (), SILENT)
    run_study(study, out, Here())

    add_facts(study, out, (), SILENT)

    found = read_paper(study, out / RECORDS)
    [fact] = found.facts
    assert len(fact.latency_us) == 10
    assert len(fact.runs_us) == FEWEST_RUNS
    assert fact.parameters is not None
    assert sum(map(len, fact.modules_us.values())) > 0
    assert [each.name for each in found.finished] == ["slow.device", "slow.ideal"]
    assert all("preview" in table.title for table in found.tables())
    # it hit what stood in its lane
    assert found.accident is not None
    times = [each.time_us for each in found.accident.moments]
    assert times == list(range(times[0], times[-1] + 1, 500_000))
    assert plans_before(found.accident).axes[0].lines
