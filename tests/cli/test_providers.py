"""Commands that open a session take a provider with libraries of operators."""

from pathlib import Path

import onnxruntime as ort
import pytest

import me2e_compress as me2e
from me2e_compress.cli.app import COMMANDS, options_of
from me2e_compress.runtime.providers import CpuProvider
from tests.support.command import Cli

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
LINES = (
    "calibrate dense.onnx frames -o out.json",
    "compare dense.onnx dense.onnx frames",
    "compress dense.onnx -r full --frames frames -o s.onnx",
    "evaluate dense.onnx -o out.json",
    "frames dense.onnx -o out.json",
    "lint dense.onnx --target onnxruntime",
    "profile dense.onnx frames -o out.json",
    "search dense.onnx frames --max-mb 9 -o r.toml",
    "sensitivity dense.onnx frames -o out.json",
    "study study.toml -o out",
)


@pytest.fixture(autouse=True)
def folder(dense: Path) -> Path:
    (dense / "study.toml").write_text(STUDY)
    (dense / "text.so").write_text("not a library")
    return dense


@pytest.mark.parametrize("line", LINES)
def test_what_is_missing_is_one_line_of_every_command(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, line: str
) -> None:
    said = cli.refused(f"{line} --provider cpu{{plugins=[none.so]}}")
    assert said.endswith("plugins library none.so: no such file")
    there = cli(f"{line} --provider cpu{{plugins=[text.so]}}").err
    assert "plugins library text.so: " in there
    monkeypatch.setattr(ort, "get_available_providers", lambda: [CpuProvider.native])
    said = cli.refused(f"{line} --provider cuda")
    assert "provider cuda: onnxruntime" in said
    assert said.endswith("pip install onnxruntime-gpu")


def test_every_command_that_takes_a_provider_is_here() -> None:
    taking = {name for name in COMMANDS if "--provider" in options_of(name)}

    assert taking == {line.split()[0] for line in LINES}


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
