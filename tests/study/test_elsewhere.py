import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import ClassVar

import pytest

from me2e_compress.errors import EvaluationError, StudyError
from me2e_compress.evaluators import EVALUATORS
from me2e_compress.evaluators.highway.engine import LocalEngine
from me2e_compress.metrics.episode import Episode
from me2e_compress.registry import registry
from me2e_compress.study import Condition, Study, StudyResult, Variant, load_study
from me2e_compress.study.run import run_study
from me2e_compress.study.workload import PlannedDrive, Workload, workload
from me2e_compress.study.write import write_study
from tests.metrics.drives import drive

DRIVEN: list[str] = []


@dataclass(frozen=True)
class Lanes:
    """Drives lanes.

    Attributes:
        policy: Who drives.
        routes: How many lanes.
    """

    name: ClassVar[str] = "lanes"
    policy: str
    routes: int = 2

    def episodes(self) -> Iterator[Episode]:
        DRIVEN.append(self.policy)
        slow = 40.0 if self.policy.startswith("blind") else 100.0
        for number in range(self.routes):
            yield drive(route=f"lane_{number}", completion=slow)


@pytest.fixture(autouse=True)
def lanes(monkeypatch: pytest.MonkeyPatch) -> None:
    module = sys.modules[__name__]
    monkeypatch.setitem(sys.modules, "lanes_of_a_test", module)
    entry = EntryPoint("lanes", "lanes_of_a_test:Lanes", EVALUATORS.group)
    installed = {EVALUATORS.group: (entry,)}
    monkeypatch.setattr(registry, "_all_installed", lambda path: installed)
    DRIVEN.clear()


TEXT = """
title = "Lanes"
baseline = "expert"
evaluator = "lanes{routes=3}"

[[variant]]
name = "expert"
policy = "expert"

[[variant]]
name = "slow"
policy = "blind:3"

[[condition]]
name = "lane"
latency = "none"
"""


@pytest.fixture
def asked(tmp_path: Path) -> Path:
    file = tmp_path / "study.toml"
    file.write_text(TEXT)
    return file


def test_another_evaluator_drives_a_study(asked: Path, tmp_path: Path) -> None:
    found = run_study(asked, tmp_path / "out")

    assert isinstance(found, StudyResult)
    assert found.coverage == (3, 3)
    assert [
        each.scores.driving_score.value for each in found.drives if each.scores
    ] == [
        100.0,
        40.0,
    ]
    difference = found.drives[1].difference
    assert difference is not None
    assert difference.driving_score.value == -60.0
    assert "3 of 3 routes" in found.headline


def test_what_was_kept_is_not_driven_again(asked: Path, tmp_path: Path) -> None:
    run_study(asked, tmp_path / "out")
    run_study(asked, tmp_path / "out")

    assert sorted(DRIVEN) == ["blind:3", "expert"]


def test_the_report_names_the_evaluator(asked: Path, tmp_path: Path) -> None:
    written = write_study(run_study(asked, tmp_path / "out"), tmp_path / "out")

    assert "3 routes of lanes{routes=3}" in written.report.read_text(encoding="utf-8")
    record = json.loads(written.record.read_text(encoding="utf-8"))
    assert record["evaluator"] == "lanes{routes=3}"
    assert record["routes"] == {"driven": 3, "set": 3}


def test_the_hours_are_the_evaluators_own(asked: Path, tmp_path: Path) -> None:
    ahead = workload(load_study(asked), tmp_path / "out")

    assert ahead.headline == "Lanes: 2 drives, of routes that the evaluator knows"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"none"', '"fps:10"', "condition lane: lanes{routes=3} has conditions of its"),
        (
            '"none"',
            '"none"\nweather = "night=1"',
            "condition lane: lanes",
        ),
        ("[[variant]]", "routes = 3\n[[variant]]", "routes: only highway understands"),
    ],
)
def test_what_highway_alone_understands(
    asked: Path, old: str, new: str, message: str
) -> None:
    asked.write_text(TEXT.replace(old, new, 1))

    with pytest.raises(StudyError, match=message):
        load_study(asked)


def test_options_of_highway_are_the_studys(asked: Path) -> None:
    asked.write_text(TEXT.replace("lanes{routes=3}", "highway{routes=3}"))

    with pytest.raises(EvaluationError, match="highway's options are the command's"):
        load_study(asked)


def test_where_it_drives_is_its_own_affair(asked: Path, tmp_path: Path) -> None:
    with pytest.raises(StudyError, match="drives where it will"):
        run_study(asked, tmp_path / "out", LocalEngine(2))


def test_an_evaluator_that_drives_nobody(tmp_path: Path) -> None:
    study = Study(
        "Read",
        (Variant("expert", "expert"),),
        (Condition("real", "none"),),
        "expert",
        (),
        0,
        evaluator="bench2drive{folder=run}",
    )

    with pytest.raises(EvaluationError, match="bench2drive drives no policy"):
        run_study(study, tmp_path / "out")


def test_a_short_study_takes_seconds_not_0_0_hours() -> None:
    drive = PlannedDrive("float", "ideal", 0, 1, 20 / 3600)
    ahead = Workload("Short", (drive,), 220, 1, False)

    assert (
        "1 drive, 1 route, 0 of them driven; about 20 s on 1 worker" in ahead.headline
    )
    assert ahead.tables()[0].rows[0][-1].text == "20 s"
