import importlib.util
import json
import re
from pathlib import Path

import pytest

from me2e_compress import graph
from me2e_compress.study import demo
from me2e_compress.workflows.module_changes import ModuleChanges
from me2e_compress.zoo import shipped
from tests.cli.conftest import Command
from tests.docs.documents import faults
from tests.stand_in import write_shipped
from tests.study.conftest import Here

ROUTE = "ParkedObstacle_0"


@pytest.fixture(autouse=True)
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A small driver in the place of the one that ships, few frames, no processes."""
    write_shipped(tmp_path / "weights")
    monkeypatch.setattr(shipped, "WEIGHTS", tmp_path / "weights")
    monkeypatch.setattr(demo, "CALIBRATION_FRAMES", 3)
    monkeypatch.setattr(demo, "HELD_OUT_FRAMES", 2)
    monkeypatch.setattr(demo, "LATENCY_SAMPLES", 5)
    monkeypatch.setattr(demo, "LocalEngine", lambda workers: Here())


def test_the_demo_compresses_drives_and_reports(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"

    assert command("demo", "--out", out, "--routes", ROUTE, "-r", "full") == 0

    shown = capsys.readouterr().out
    steps = [line.split()[0] for line in shown.splitlines()[:4]]
    assert steps == ["compress", "weigh", "compare", "drive"]
    assert len(shown.splitlines()) <= 25
    assert "on the road: too few routes; 0 of 1 routes differ" in shown
    assert (
        "1 route cannot show a difference below 24 points, all 220 (--routes all) n"
        in shown
    )
    record = json.loads((out / "study.json").read_text())
    assert [each["name"] for each in record["schemes"]] == ["float", "full"]
    assert record["schemes"][1]["model_sha256"] == graph.sha256_of(
        out / "highway.full.onnx"
    )
    assert "quantize-int8" in record["schemes"][1]["pipeline"]
    assert 'target="onnxruntime"' in record["schemes"][1]["pipeline"]
    assert record["routes"] == {"driven": 1, "set": 220}
    page = (out / "report.html").read_text()
    for heading in ("The passes", "The modules", "The outputs", "Files"):
        assert f"<h2>{heading}</h2>" in page
    links = re.findall('<a href="([^"]*)"', page)
    assert "highway.full.onnx" in links
    assert [name for name in links if not (out / name).exists()] == []


def test_all_tables_are_shown_to_who_asks(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--out", tmp_path / "out", "--routes", ROUTE, "-r", "full")
    assert command("-v", "demo", *words) == 0

    shown = capsys.readouterr().out
    for title in ("Pass by pass", "Module by module", "Fidelity over 2 frames"):
        assert shown.count(title) == 1
    assert shown.count("Scoreboard") == 1


@pytest.mark.parametrize("name", ["report.html", "highway.full-fused.onnx", "frames"])
def test_what_is_there_is_refused_before_any_work(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    out = tmp_path / "out"
    theirs = out / name
    if name == "frames":
        theirs.mkdir(parents=True)
        (theirs / "notes.txt").write_text("mine")
    else:
        out.mkdir()
        theirs.write_text("mine")

    assert command("demo", "--out", out) == 1

    assert str(theirs) in capsys.readouterr().err
    assert [each.name for each in out.iterdir() if each.name[0] != "."] == [name]


def test_all_its_steps_are_one_document(
    command: Command,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    found = ModuleChanges((), ())
    names = ("compress", "weigh", "compare", "drive")
    steps = {name: lambda listener: found for name in names}
    monkeypatch.setattr(demo.DriverDemo, "steps", property(lambda self: steps))

    assert command("demo", "--out", tmp_path / "out", "--json") == 0

    document = json.loads(capsys.readouterr().out)
    assert faults("demo", document) == []
    assert document["drive"] == {"before": [], "after": []}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--routes", "0"), "0 routes were asked for"),
        (("--recipe", "half"), "no recipe half"),
    ],
)
def test_what_is_wrong_is_one_line(
    command: Command,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    words: tuple[str, str],
    message: str,
) -> None:
    assert command("demo", "--out", tmp_path / "out", *words) == 1
    assert message in capsys.readouterr().err


def test_a_stack_nobody_knows_is_a_usage_error(command: Command) -> None:
    assert command("demo", "--stack", "uniad") == 2


def test_without_the_extra_the_demo_says_what_to_install(
    command: Command,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)

    assert command("demo", "--out", tmp_path / "out") == 1
    assert "me2e-compress[highway]" in capsys.readouterr().err
