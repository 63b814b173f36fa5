import json
import re
from pathlib import Path

import pytest
import typer.main

from me2e_compress.cli.app import app
from tests.cli.conftest import Command, strict

NAMES = sorted(typer.main.get_command(app).commands)  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", NAMES)
def test_every_command_explains_itself(
    command: Command, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    assert command(name, "--help") == 0
    assert name in capsys.readouterr().out


@pytest.mark.parametrize("name", NAMES)
def test_every_command_stands_in_the_readme(name: str) -> None:
    readme = Path(__file__).parents[2] / "README.md"
    assert re.search(rf"me2e-compress {name}\b", readme.read_text(encoding="utf-8"))


def test_a_wrong_word_is_a_usage_error(command: Command) -> None:
    assert command("compres") == 2


def test_inspect_counts_by_module(
    command: Command, files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("inspect", files / "in.onnx", "--map", files / "map.toml", "--json")
    assert command(*words) == 0
    found = json.loads(capsys.readouterr().out)
    counts = {item["module"]: item["nodes"] for item in found["modules"]}
    assert counts == {"backbone": 1, "occ": 1, "planner": 1}
    assert found["inputs"] == [{"name": "camera", "type": "FLOAT", "shape": "[1,4]"}]


def test_inspect_for_people(
    command: Command, files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("inspect", files / "in.onnx", "--map", files / "map.toml") == 0
    assert "3 by scope" in capsys.readouterr().out


def test_a_graph_compared_with_itself_is_equal(
    command: Command, files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = (files / "in.onnx", files / "in.onnx", files / "frames", "--json")
    assert command("compare", *words) == 0
    found = strict(capsys.readouterr().out)
    assert [item["error"] for item in found["outputs"]] == [0.0]
    assert [item["sqnr_db"] for item in found["outputs"]] == [None]
    assert found["frames"] == 2


def test_doctor_names_the_versions(
    command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("doctor", "--json") == 0
    found = {
        item["what"]: item["found"] for item in json.loads(capsys.readouterr().out)
    }
    assert found["onnxruntime"]
