"""``build`` writes an engine, and claims its output as every command does."""

import json
from pathlib import Path

import pytest

from me2e_compress.targets.tensorrt.tensorrt_engine import (
    EngineSettings,
    TensorRTEngine,
)
from me2e_compress.workflows import build as workflow
from tests.cli.conftest import Command
from tests.docs.documents import faults


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[EngineSettings]:
    """What TensorRT was asked for; it answers at once."""
    found: list[EngineSettings] = []

    def build_engine(path: Path, settings: EngineSettings) -> TensorRTEngine:
        found.append(settings)
        return TensorRTEngine(b"engine", "10.4.0", 3, 1.5)

    monkeypatch.setattr(workflow, "build_engine", build_engine)
    return found


def test_an_engine_is_written(
    command: Command,
    dense: Path,
    asked: list[EngineSettings],
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ("--precision", "fp16", "--tactic-source", "CUBLAS", "--json")

    assert command("build", dense / "dense.onnx", "-o", dense / "d.engine", *words) == 0

    assert (dense / "d.engine").read_bytes() == b"engine"
    assert asked == [EngineSettings("fp16", ("CUBLAS",))]
    assert faults("build", json.loads(capsys.readouterr().out)) == []


def test_a_file_of_the_users_is_not_written_over(
    command: Command, dense: Path, asked: list[EngineSettings]
) -> None:
    (dense / "d.engine").write_text("mine")

    assert command("build", dense / "dense.onnx", "-o", dense / "d.engine") == 1
    assert asked == []
    assert (dense / "d.engine").read_text() == "mine"
