"""Evaluators beside highway: they drive with all that they declare."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from me2e_compress import evaluate, score
from me2e_compress.base.errors import EvaluationError, GraphError
from me2e_compress.base.listener import Listener
from me2e_compress.commands.options import EvaluateOptions
from tests.evaluators.bench2drive.files import checkpoint, record, write
from tests.evaluators.highway.drivers import straight_on
from tests.evaluators.lanes import DRIVEN, install_lanes

ADAPTER = '[plan]\noutput = "way"\n'


@pytest.fixture(autouse=True)
def lanes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    install_lanes(monkeypatch, tmp_path)


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """A model that only its adapter makes a driver of."""
    (tmp_path / "a.toml").write_text(ADAPTER)
    outputs, body = "float[1, 6, 2] way", "way = Identity (ahead)"
    return straight_on(tmp_path / "m.onnx", outputs=outputs, body=body)


def test_a_plug_in_drives_with_routes_adapter_latency_and_progress(
    model: Path, tmp_path: Path
) -> None:
    reports = list[tuple[str, int, int, str]]()
    asked = EvaluateOptions(
        evaluator="lanes{count=3}",
        routes="2",
        adapter=tmp_path / "a.toml",
        latency="fps:4",
    )
    listener = Listener(lambda *report: reports.append(report))

    result = evaluate(model, tmp_path / "r", asked, listener)

    assert (result.scores.routes, result.scores.expected) == (2, 3)
    assert result.scores.driving_score.value == 50.0
    assert result.deadlines is not None
    assert result.deadlines.measures["max_ms"].value == 250.0
    driving = [report for report in reports if report[0] == "evaluate"]
    assert [report[1:3] for report in driving] == [(0, 2), (1, 2), (2, 2)]
    assert driving[-1][3] == "routes"
    manifest = json.loads((tmp_path / "r" / "evaluation.json").read_text())
    assert manifest["routes"] == ["lane_0", "lane_1"]
    assert manifest["latency"] == {"fixed_us": 250_000}
    (scored,) = score(tmp_path / "r").scores.values()
    assert scored == result.scores


def test_a_plug_in_goes_on_where_it_stopped(model: Path, tmp_path: Path) -> None:
    asked = EvaluateOptions(evaluator="lanes", adapter=tmp_path / "a.toml")
    first = evaluate(model, tmp_path / "r", asked)
    (tmp_path / "r" / "routes" / "lane_2.json").write_text("{")
    DRIVEN.clear()

    again = evaluate(model, tmp_path / "r", asked)

    assert DRIVEN == [("m", "lane_2")]
    assert again.scores == first.scores
    with pytest.raises(EvaluationError, match="of another evaluation: its latency"):
        evaluate(model, tmp_path / "r", replace(asked, latency="fps:4"))


def test_results_of_a_real_run_are_an_evaluator_too(tmp_path: Path) -> None:
    write(tmp_path / "run" / "r.json", checkpoint(record()))
    asked = EvaluateOptions(evaluator=f"bench2drive{{folder={tmp_path / 'run'}}}")

    found = evaluate(None, tmp_path / "out", asked)

    assert (found.scores.routes, found.scores.expected) == (1, 220)
    file = tmp_path / "out" / "routes" / "RouteScenario_1711_rep0.json"
    episode = json.loads(file.read_text())["episode"]
    assert episode["given"]["status"] == "Completed"
    # what is read is read again
    write(tmp_path / "run" / "s.json", checkpoint(record(1773)))
    with pytest.raises(EvaluationError, match="another evaluation: its routes is"):
        evaluate(None, tmp_path / "out", asked)


@pytest.mark.parametrize(
    ("policy", "text", "message"),
    [
        ("a", "lanes{speed=3}", "lanes has no option 'speed'"),
        (None, "lanes", "lanes drives a policy: name one"),
        ("a", "nobody", "no evaluator 'nobody'; there are highway, bench2drive, lanes"),
        ("gone.onnx", "lanes", r"gone\.onnx: no such file"),
        (None, "tape{named=[]}", "tape yields no episode"),
        (None, "tape{named=[twin, twin]}", "tape yields route twin twice"),
        (None, 'tape{named=["../x"]}', "a name is made of letters"),
        ("a", "tape", "tape drives no policy: leave out a"),
        (None, "highway", "highway drives a policy: name one"),
        ("a", "highway{routes=3}", "highway has no option 'routes'; it has none"),
    ],
)
def test_wrong_words_are_one_line_and_leave_nothing(
    tmp_path: Path, policy: str | None, text: str, message: str
) -> None:
    with pytest.raises(EvaluationError, match=message):
        evaluate(policy, tmp_path / "r", EvaluateOptions(evaluator=text))
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize(
    ("way", "message"),
    [
        ("twin", "lanes yields route lane_0 twice"),
        ("strange", "lanes yields route lane_9, not of its drive"),
        ("lost", "lanes did not drive route lane_0"),
    ],
)
def test_routes_that_were_not_asked_for(
    model: Path, tmp_path: Path, way: str, message: str
) -> None:
    asked = EvaluateOptions(
        evaluator=f"lanes{{way={way}}}", adapter=tmp_path / "a.toml"
    )
    with pytest.raises(EvaluationError, match=message):
        evaluate(model, tmp_path / "r", asked)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (EvaluateOptions(weather="night=1"), "--weather: lanes takes no weather; it"),
        (EvaluateOptions(module_map="m.toml"), "--map: lanes takes no module-map"),
        (EvaluateOptions(render="all"), "--render: lanes takes no render"),
        (EvaluateOptions(workers=2), "--workers: lanes takes no engine; it takes pol"),
    ],
)
def test_what_an_evaluator_does_not_take_is_refused_by_name(
    tmp_path: Path, asked: EvaluateOptions, message: str
) -> None:
    with pytest.raises(EvaluationError, match=message):
        evaluate("a", tmp_path / "r", replace(asked, evaluator="lanes"))
    assert not (tmp_path / "r").exists()


def test_a_folder_that_is_read_is_not_written(tmp_path: Path) -> None:
    write(tmp_path / "r.json", checkpoint(record()))

    asked = EvaluateOptions(evaluator=f"bench2drive{{folder={tmp_path}}}")

    with pytest.raises(GraphError, match="is the input"):
        evaluate(None, tmp_path, asked)
