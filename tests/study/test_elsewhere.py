"""Studies of another evaluator than highway."""

import json
from pathlib import Path

import pytest

from me2e_compress.base.errors import EvaluationError, StudyError
from me2e_compress.evaluators.highway.engine import LocalEngine
from me2e_compress.runtime.profile import in_turn_text
from me2e_compress.runtime.providers import CpuProvider
from me2e_compress.study import Study, StudyResult, Timing, load_study, run_study
from me2e_compress.study.report.page import write_study
from tests.evaluators.lanes import install_lanes
from tests.study.conftest import IDEAL, ROUTES, Make
from tests.support.in_process import Here

TEXT = """
title = "Lanes"
baseline = "fast"
evaluator = "lanes{count=5}"
routes = 3

[[variant]]
name = "fast"
policy = "fast.onnx"

[[variant]]
name = "slow"
policy = "slow.onnx"

[[condition]]
name = "ideal"
latency = "none"

[[condition]]
name = "late"
latency = "fps:4"
"""


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, models: Path) -> Path:
    install_lanes(monkeypatch, tmp_path)
    file = tmp_path / "study.toml"
    text = TEXT.replace('"fast.onnx"', f'"{models}/fast.onnx"')
    file.write_text(text.replace('"slow.onnx"', f'"{models}/slow.onnx"'))
    return file


def test_another_evaluator_drives_a_study(asked: Path, tmp_path: Path) -> None:
    result = run_study(asked, tmp_path / "out")

    assert isinstance(result, StudyResult)
    assert result.coverage == (3, 5)
    scores = [
        drive.scores.driving_score.value for drive in result.drives if drive.scores
    ]
    assert scores == [100.0, 50.0] * 2
    difference = result.drives[1].difference
    assert difference is not None
    assert difference.driving_score.value == -50.0
    assert [drive.mean_latency_us for drive in result.drives] == [
        0,
        0,
        250_000,
        250_000,
    ]
    assert "3 of 5 routes" in result.headline
    written = write_study(result, tmp_path / "out")
    page = written.report.read_text(encoding="utf-8")
    assert "the same 3 of 5 routes of lanes{count=5}" in page
    document = json.loads(written.record.read_text(encoding="utf-8"))
    assert document["evaluator"] == "lanes{count=5}"
    assert document["routes"] == {"driven": 3, "set": 5}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"none"', '"none"\nweather = "night=1"', "condition ideal: lanes takes no we"),
        ('"lanes{count=5}"', '"tape"', "variant fast: tape takes no policy"),
    ],
)
def test_what_an_evaluator_does_not_take(
    asked: Path, old: str, new: str, message: str
) -> None:
    asked.write_text(asked.read_text().replace(old, new, 1))

    with pytest.raises(StudyError, match=message):
        load_study(asked)


def test_where_it_drives_is_its_own_affair(asked: Path, tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="workers and engine: lanes takes no eng"):
        run_study(asked, tmp_path / "out", LocalEngine(2))


# Whatever a study runs, it runs on its provider.


@pytest.fixture
def provided(make: Make, tmp_path: Path) -> Study:
    """Two models on one route, with a library of operators."""
    library = tmp_path / "operators.so"
    library.touch()
    return make(
        variants=make().variants[1:3],
        conditions=(IDEAL,),
        routes=ROUTES[:1],
        timing=Timing(1),
        provider=CpuProvider(plugins=(library,)),
    )


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Path, ...]]:
    """The libraries of every session that is opened; none is loaded."""
    plugins: list[tuple[Path, ...]] = []
    attach = lambda self, options: plugins.append(self.plugins)  # noqa: E731
    monkeypatch.setattr(CpuProvider, "attach", attach)
    return plugins


@pytest.mark.usefixtures("short")
def test_every_session_of_a_study_is_on_its_provider(
    provided: Study, opened: list[tuple[Path, ...]], tmp_path: Path
) -> None:
    folder = tmp_path / "out"

    result = run_study(provided, folder, Here())

    assert set(opened) == {provided.provider.plugins}
    (trace,) = (folder / "traces").glob("slow*")
    machine = in_turn_text(1, provided.provider)
    assert json.loads(trace.read_text())["machine"] == machine
    assert "operators.so" in machine
    assert "operators.so" in result.to_json()["provider"]
