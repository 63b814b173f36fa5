import importlib.util
import json
from pathlib import Path

import pytest

from me2e_compress import graph
from me2e_compress.commands.frames import FramesResult
from me2e_compress.study import demo
from tests.support.command import Cli
from tests.support.in_process import Here

DEMO = "demo --out out"


@pytest.fixture(autouse=True)
def small(weights: Path, here: Here, monkeypatch: pytest.MonkeyPatch) -> None:
    """A small driver in the place of the one that ships, few frames, no processes."""
    monkeypatch.setattr(demo, "CALIBRATION_FRAMES", 3)
    monkeypatch.setattr(demo, "HELD_OUT_FRAMES", 2)
    monkeypatch.setattr(demo, "LATENCY_SAMPLES", 5)
    monkeypatch.setattr(demo, "ROUTES", "ParkedObstacle_R2_0")
    monkeypatch.setattr(demo, "RECIPE", "full")


def test_the_demo_compresses_drives_and_reports(cli: Cli, tmp_path: Path) -> None:
    shown = cli.done(DEMO).out

    out = tmp_path / "out"
    steps = [line.split()[0] for line in shown.splitlines()[:4]]
    assert steps == ["compress", "weigh", "compare", "drive"]
    assert len(shown.splitlines()) <= 25
    words = " ".join(shown.split())
    assert "the time of a decision; driving score +0.0 points, too few routes." in words
    limit = "1 route cannot show a difference below 51.0 points of driving score, all"
    assert f"{limit} 220 none below 3.4. Decisions cost no time under ideal" in words
    assert "compress highway -r full --target tensorrt --frames" in words
    assert "slow in onnxruntime's CPU" not in shown
    record = json.loads((out / "study.json").read_text())
    assert [each["name"] for each in record["schemes"]] == ["float", "full"]
    assert record["schemes"][1]["model_sha256"] == graph.sha256_of(
        out / "highway.full.onnx"
    )
    assert "quantize-int8" in record["schemes"][1]["pipeline"]
    assert 'target="onnxruntime"' in record["schemes"][1]["pipeline"]
    assert record["routes"] == {"driven": 1, "set": 220}
    assert "<summary>Scoreboard" in (out / "report.html").read_text()  # .ci/run, too


@pytest.mark.parametrize("name", ["report.html", "highway.full.onnx", "frames"])
def test_what_is_there_is_refused_before_any_work(
    cli: Cli, tmp_path: Path, name: str
) -> None:
    theirs = tmp_path / "out" / name
    theirs = theirs / "notes.txt" if name == "frames" else theirs
    theirs.parent.mkdir(parents=True)
    theirs.write_text("mine")

    assert f"out/{name}" in cli.refused("demo --out out")


@pytest.fixture
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps that are done at once: `0 frames of m` is the result of all."""
    result = FramesResult("m", Path("f"), 0)
    names = ("compress", "weigh", "compare", "drive")
    steps = {name: lambda listener: result for name in names}
    monkeypatch.setattr(demo.DriverDemo, "steps", property(lambda self: steps))


@pytest.mark.usefixtures("fast")
def test_all_its_steps_are_one_document(cli: Cli) -> None:
    assert cli.document(DEMO)["drive"]["frames"] == 0


@pytest.mark.usefixtures("fast")
@pytest.mark.parametrize(("words", "times"), [("", 4 + 1), ("-v ", 4 + 4)])
def test_a_step_is_shown_in_full_to_who_asks_and_the_last_to_all(
    cli: Cli, words: str, times: int
) -> None:
    """Each has a line of its own as soon as it is done."""
    assert cli.done(f"{words}{DEMO}").out.count("0 frames of m") == times


@pytest.mark.parametrize("line", ["demo --out out", "frames highway -o made"])
def test_without_the_extra_it_says_what_to_install(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, line: str
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)

    assert "me2e-compress[highway]" in cli.refused(line)
