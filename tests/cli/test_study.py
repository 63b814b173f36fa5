import json
from pathlib import Path

import numpy as np
import pytest

import me2e_compress.study.run
from me2e_compress.cli.commands.study import study
from me2e_compress.errors import StudyError
from me2e_compress.evaluators.highway import evaluator
from me2e_compress.marks import IN_JSON
from me2e_compress.simulator.routes import save_routes
from me2e_compress.study import Study
from me2e_compress.zoo.shipped import shipped
from tests.cli.conftest import Command, write_frames
from tests.docs.documents import faults
from tests.evaluators.highway.drivers import CROSSING, straight_on
from tests.study.conftest import Here

STUDY = """
title = "Try"
baseline = "float"
routes = "routes.json"
held_out = "frames"

[latency]
samples = 10
baseline_median_s = 0.2

[[scheme]]
name = "float"
policy = "m.onnx"

[[scheme]]
name = "exact"
policy = "m.onnx"
recipe = "exact"

[[condition]]
name = "device"
latency = "trace"
"""


@pytest.fixture(autouse=True)
def here(monkeypatch: pytest.MonkeyPatch) -> Here:
    """Drive in this process."""
    engine = Here()
    monkeypatch.setattr(evaluator, "engine_of", lambda *words: engine)
    return engine


@pytest.fixture
def toml(tmp_path: Path) -> Path:
    path = tmp_path / "study.toml"
    path.write_text(STUDY)
    straight_on(tmp_path / "m.onnx")
    save_routes((CROSSING,), tmp_path / "routes.json")
    write_frames(tmp_path / "frames", command=np.array([3]))
    return path


def test_a_study_leaves_a_report_and_prints_its_tables(
    command: Command, toml: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("study", toml, "-o", tmp_path / "out") == 0

    shown = capsys.readouterr().out
    assert "Scoreboard, device" in shown
    assert "Difference to float" in shown
    files = {path.name for path in (tmp_path / "out").iterdir()}
    assert files >= {"study.json", "tables.md", "report.html", "results", "traces"}
    text = (tmp_path / "out" / "report.html").read_text()
    assert f"me2e-compress study {toml} -o" in text


def test_json_is_the_file(
    command: Command, toml: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert command("study", toml, "-o", out, "--json") == 0

    shown = json.loads(capsys.readouterr().out)
    saved = json.loads((out / "study.json").read_text())
    known = {key: shown[key] for key in saved if key in shown}
    assert saved == IN_JSON | known
    assert faults("study", shown) == []
    assert [each["scheme"] for each in shown["drives"]] == ["float", "exact"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            '"m.onnx"\n\n',
            '"uniad"\n\n',
            "uniad: no such file; models that ship: highway",
        ),
        ('"exact"\npolicy', '"float"\npolicy', "2 variants are named float"),
        ('recipe = "exact"', 'recipe = "exakt"', "no recipe exakt"),
        ('"frames"', '"nowhere"', "nowhere: no such folder"),
        ("[[condition]]", "[[conditions]]", "no key conditions; there are title"),
    ],
)
def test_what_is_wrong_is_one_line(
    command: Command,
    toml: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    old: str,
    new: str,
    message: str,
) -> None:
    assert old in STUDY
    toml.write_text(STUDY.replace(old, new))

    assert command("study", toml, "-o", tmp_path / "out") == 1

    line = capsys.readouterr().err
    assert message in line
    assert line.count("\n") == 1


def test_a_model_that_ships_is_not_one_where_you_are(
    toml: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    straight_on(elsewhere / "highway")
    monkeypatch.chdir(elsewhere)
    toml.write_text(STUDY.replace('"m.onnx"', '"highway"'))
    asked = list[Study]()

    def noted(found: Study, *_: object, **__: object) -> None:
        asked.append(found)
        raise StudyError("seen")

    monkeypatch.setattr(me2e_compress.study.run, "run_study", noted)
    with pytest.raises(StudyError, match="seen"):
        study(toml, tmp_path / "out")

    assert asked[0].variants[0].policy == str(shipped("highway"))


def test_an_engine_nobody_knows(
    command: Command,
    toml: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.undo()

    assert command("study", toml, "-o", tmp_path / "out", "--engine", "cloud") == 1
    assert "engine 'cloud'" in capsys.readouterr().err


PAPER = (
    STUDY.replace('"Try"', '"Again"\nreport = "paper"')
    + """
[[block]]
name = "table-3"
variants = ["float"]
conditions = ["device"]
"""
)


def test_the_papers_tables_are_written_and_read_again(
    command: Command,
    toml: Path,
    tmp_path: Path,
    here: Here,
    capsys: pytest.CaptureFixture[str],
) -> None:
    toml.write_text(PAPER)
    out, again = tmp_path / "out", tmp_path / "again"
    assert command("study", toml, "-o", out, "--json") == 0
    shown = json.loads(capsys.readouterr().out)
    driven = list(here.driven)

    assert command("study", toml, "-o", again, "--records", out / "records") == 0

    assert faults("study", shown) == []
    assert [each["scheme"] for each in shown["drives"]] == ["float"]
    assert here.driven == driven
    assert (again / "tables.md").read_bytes() == (out / "tables.md").read_bytes()


def test_a_dry_run_drives_nothing(
    command: Command,
    toml: Path,
    tmp_path: Path,
    here: Here,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "out"
    assert command("study", toml, "-o", out, "--dry-run", "--json") == 0

    shown = json.loads(capsys.readouterr().out)
    assert faults("study", shown) == []
    assert len(shown["drives"]) == 2
    assert here.driven == []
    assert not out.exists()


def test_the_study_that_ships_is_found_by_its_name(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("study", "paper", "-o", tmp_path / "out", "--routes", "44", "--dry-run")
    assert command(*words) == 0

    shown = capsys.readouterr().out
    assert "The paper, re-tested: 36 drives, 1,584 routes, 0 of them driven" in shown
