"""Commands that open a session take a provider and libraries of operators."""

from pathlib import Path

import onnxruntime as ort
import pytest

import me2e_compress as me2e
from me2e_compress.cli import commands
from me2e_compress.runtime.providers import CpuProvider
from tests.cli.conftest import Command

COMMANDS = (
    *("calibrate", "compare", "compress", "demo", "evaluate", "frames", "lint"),
    *("profile", "search", "sensitivity", "study"),
)
STUDY = """
title = "Try"
baseline = "dense"
held_out = "frames"

[[variant]]
name = "dense"
policy = "dense.onnx"

[[condition]]
name = "ideal"
latency = "none"
"""


def words(folder: Path, name: str) -> list[str | Path]:
    """Return a command that opens a session, and its arguments."""
    model, frames = folder / "dense.onnx", folder / "frames"
    if name == "compress":
        return [name, model, "-r", "full", "--frames", frames, "-o", folder / "s.onnx"]
    if name == "search":
        return [name, model, frames, "--max-mb", "9", "-o", folder / "r.toml"]
    if name == "compare":
        return [name, model, model, frames]
    if name == "lint":
        return [name, model, "--target", "onnxruntime"]
    if name == "demo":
        return [name, "-o", folder / "out"]
    if name == "study":
        (folder / "study.toml").write_text(STUDY)
        return [name, folder / "study.toml", "-o", folder / "out"]
    recording = [] if name in ("evaluate", "frames") else [frames]
    return [name, model, *recording, "-o", folder / "out.json"]


@pytest.mark.parametrize("name", COMMANDS)
def test_a_library_that_is_missing_is_one_line(
    name: str, command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    library = dense / "none.so"

    assert command(*words(dense, name), "--plugins", library) == 1

    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.endswith(f"plugins library {library}: no such file")


@pytest.mark.parametrize("name", COMMANDS)
def test_a_provider_that_is_missing_is_one_line(
    name: str,
    command: Command,
    dense: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(ort, "get_available_providers", lambda: [CpuProvider.native])

    assert command(*words(dense, name), "--provider", "cuda") == 1

    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "provider cuda: onnxruntime" in line
    assert line.endswith("pip install onnxruntime-gpu")


@pytest.mark.parametrize("name", COMMANDS)
def test_the_first_session_of_a_command_has_the_library(
    name: str, command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    library = dense / "text.so"
    library.write_text("not a library")

    assert command(*words(dense, name), "--plugins", library) == 1

    assert f"plugins library {library}: " in capsys.readouterr().err


def test_every_command_that_takes_a_provider_is_here() -> None:
    taking = {
        file.stem
        for file in Path(commands.__file__).parent.glob("*.py")
        if "provider" in file.read_text("utf-8")
    }

    assert taking == set(COMMANDS)


def test_a_lint_for_tensorrt_opens_no_session(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    library = dense / "lib.so"
    library.touch()

    assert command("lint", dense / "dense.onnx", "--plugins", library) == 1

    assert "lint for tensorrt opens no session" in capsys.readouterr().err


def test_compress_runs_every_graph_on_the_provider(
    dense: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[tuple[Path, ...]] = []
    library = dense / "lib.so"
    library.touch()
    monkeypatch.setattr(
        CpuProvider, "attach", lambda self, options: opened.append(self.plugins)
    )
    options = me2e.CompressOptions(
        module_map=dense / "map.toml", provider=CpuProvider(plugins=(library,))
    )

    me2e.compress(
        dense / "dense.onnx", dense / "s.onnx", "full", dense / "frames", options
    )

    assert opened
    assert set(opened) == {(library,)}
