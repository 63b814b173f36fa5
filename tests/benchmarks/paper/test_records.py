"""The pages that are kept, and facts of a study that was driven."""

import re
from pathlib import Path

import numpy as np
import pytest

from benchmarks.paper import weigh
from benchmarks.paper.__main__ import PAGE
from benchmarks.paper.accident import plans_before
from benchmarks.paper.evidence import FEWEST_RUNS
from benchmarks.paper.records import RECORDS, add_facts, read_paper
from me2e_compress.base.errors import StudyError
from me2e_compress.base.listener import SILENT
from me2e_compress.simulator.routes import Route
from me2e_compress.study import Condition, Study, Timing, Variant, run_study
from me2e_compress.study.definition import StudyBlock
from tests.evaluators.highway.drivers import straight_on
from tests.study.conftest import IDEAL
from tests.support.command import write_frames
from tests.support.in_process import Here

CRASHED = Route("crashed", "Accident", 1)


def test_the_page_is_that_of_the_drives_that_are_kept() -> None:
    text = PAGE.path.read_text("utf-8")

    [asked_at] = re.findall("; questions committed (.*?)\\. All", text)

    assert text == PAGE.text(asked_at)


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
