import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from typer.testing import CliRunner

from me2e_compress.cli.app import app
from me2e_compress.errors import EvaluationError
from me2e_compress.marks import IN_JSON
from me2e_compress.runtime.latency_trace import LatencyTrace
from me2e_compress.simulator.routes import save_routes
from tests.docs.documents import faults
from tests.evaluators.highway.drivers import CROSSING, PARKED, straight_on

Run = Callable[..., str]


@pytest.fixture
def run() -> Run:
    def invoke(*words: str | Path) -> str:
        result = CliRunner().invoke(app, [str(word) for word in words])
        if result.exception is not None:
            raise result.exception
        return result.stdout

    return invoke


@pytest.fixture
def manifest(tmp_path: Path) -> Path:
    save_routes((CROSSING, PARKED), tmp_path / "routes.json")
    return tmp_path / "routes.json"


def test_evaluate_and_score_say_the_same(
    run: Run, manifest: Path, tmp_path: Path
) -> None:
    results = tmp_path / "results"
    driven = json.loads(
        run("evaluate", "blind", "--routes", manifest, "-o", results, "--json")
    )
    document = json.loads(run("score", results, "--json"))

    assert faults("evaluate", driven) == []
    assert faults("score", document) == []
    (scored,) = document["folders"]
    assert {"results": str(results), **driven}.items() >= scored.items()
    assert scored["success_rate"]["value"] == 0.0
    routes = {"driven": 2, "expected": 2, "partial": False, "failed": 0}
    assert scored["routes"] == routes
    assert set(scored["driving_score"]) >= {"value", "low", "high", "n"}


def test_a_drive_tells_no_more_of_its_latencies_than_their_trace(
    run: Run, manifest: Path, tmp_path: Path
) -> None:
    trace, results = tmp_path / "trace.json", tmp_path / "results"
    LatencyTrace("0", "a CPU", (10_000,) * 16).save(trace)
    words = ("--routes", manifest, "--latency", f"trace:{trace}", "-o", results)

    driven = json.loads(run("evaluate", "blind", *words, "--json"))["deadlines"]

    (folder,) = json.loads(run("score", results, "--json"))["folders"]
    assert driven["decisions"] >= 100
    assert (driven["p50_ms"], driven["p99_ms"]) == (10.0, None)
    assert folder["deadlines"] == driven


def test_a_completion_beyond_the_whole_route_is_left_out(
    run: Run, manifest: Path, tmp_path: Path
) -> None:
    results = tmp_path / "results"
    run("evaluate", "blind", "--routes", manifest, "-o", results)
    file = results / "routes" / "parked.json"
    record = json.loads(file.read_text())
    record["episode"]["completion_percent"] = 5000.0
    file.write_text(json.dumps(record))

    (scored,) = json.loads(run("score", results, "--json"))["folders"]
    assert scored["routes"]["driven"] == 1


def test_one_route_counts_once_whatever_its_file_is_called(
    run: Run, manifest: Path, tmp_path: Path
) -> None:
    results = tmp_path / "results"
    run("evaluate", "blind", "--routes", manifest, "-o", results)
    copied = (results / "routes" / "crossing.json").read_bytes()
    (results / "routes" / "parked.json").write_bytes(copied)

    (scored,) = json.loads(run("score", results, "--json"))["folders"]
    assert scored["routes"]["driven"] == 1


def test_score_says_partial(run: Run, manifest: Path, tmp_path: Path) -> None:
    results = tmp_path / "results"
    run("evaluate", "blind", "--routes", manifest, "-o", results)
    (results / "routes" / "parked.json").unlink()

    shown = " ".join(run("score", results).split())
    assert "1 of 2 routes, PARTIAL" in shown


def test_a_route_is_drawn(run: Run, manifest: Path, tmp_path: Path) -> None:
    results, model = tmp_path / "results", straight_on(tmp_path / "m.onnx")
    run(
        *("evaluate", model, "--routes", manifest, "-o", results),
        *("--render", "crossing", "--weather", "fog_m=60,dropped=BACK+FRONT_LEFT"),
    )

    assert (results / "crossing.gif").read_bytes().startswith(b"GIF89a")
    assert (results / "crossing.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--render", "nowhere"), "no route 'nowhere'"),
        (("--engine", "cloud"), "engine 'cloud'"),
        (("--engine", "local:a:1"), "engine 'local' with address a:1"),
        (("--weather", "snow=1"), "weather option 'snow'"),
        (("--weather", "night=dark"), "weather option night"),
        (("--latency", "fast"), "no latency source 'fast'"),
        (("--dt-ms", "30"), "a step of 30 ms"),
    ],
)
def test_wrong_words_are_one_line_and_leave_nothing(
    run: Run, manifest: Path, tmp_path: Path, words: tuple[str, ...], message: str
) -> None:
    results = tmp_path / "results"

    with pytest.raises(EvaluationError, match=message) as caught:
        run("evaluate", "blind", "--routes", manifest, "-o", results, *words)
    assert "\n" not in str(caught.value)
    assert not results.exists()


def test_options_of_real_runs_want_one(run: Run, tmp_path: Path) -> None:
    (tmp_path / "evaluation.json").write_text('{"routes": ["a"]}')

    with pytest.raises(EvaluationError, match="no results of a real run, which --metr"):
        run("score", tmp_path, "--penalties", "2.0")


def test_score_of_a_folder_that_is_not_there(run: Run, tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match=r"nodir: no such folder$"):
        run("score", tmp_path / "nodir")


def test_score_of_another_folder(run: Run, tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="not a results folder"):
        run("score", tmp_path)


def test_a_figure_of_no_known_kind(run: Run, tmp_path: Path) -> None:
    words = ("-o", tmp_path / "t.json", "--figure", tmp_path / "tail.gif")
    with pytest.raises(EvaluationError, match=r"tail\.gif: a figure ends in \.png"):
        run("profile", "highway", tmp_path, *words)


def test_a_profile_is_a_latency_trace(run: Run, manifest: Path, tmp_path: Path) -> None:
    model = tmp_path / "m.onnx"
    text = """<ir_version: 8, opset_import: ["" : 17]>
    double (float[3] x) => (float[3] y) { y = Add (x, x) }"""
    onnx.save(onnx.parser.parse_model(text), model)
    frames, trace = tmp_path / "frames", tmp_path / "trace.json"
    frames.mkdir()
    for index in range(4):
        np.savez(frames / f"{index}.npz", x=np.zeros(3, np.float32))
    (frames / "scenes.json").write_text('{"scenes": [0]}')

    picture = tmp_path / "tail.png"

    words = ("profile", model, frames, "-o", trace, "--figure", picture, "--json")
    shown = json.loads(run(*words))

    assert picture.read_bytes().startswith(b"\x89PNG")
    assert [each["name"] for each in shown["modules"]] == ["model", "(between nodes)"]
    saved = json.loads(trace.read_text())
    known = {key: shown[key] for key in saved if key in shown}
    assert saved == IN_JSON | known
    assert faults("profile", shown) == []
    assert len(shown["samples_us"]) == 4
    assert shown["p50_us"] <= shown["max_us"]
    assert shown["p90_us"] is shown["p99_us"] is None  # of four samples
    latency = f"trace:{trace}"
    run(
        *("evaluate", "blind", "--routes", manifest, "-o", tmp_path / "r"),
        *("--latency", latency, "--in-order", "--latency-scale", "1000"),
    )
