import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph, rewrite
from me2e_compress.cli import main
from tests.conftest import DRIVER, DRIVER_MAP

Command = Callable[..., int]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Command:
    """Run ``me2e-compress`` with these words; give its exit code."""

    def run(*words: str | Path) -> int:
        argv = ["me2e-compress", *(str(word) for word in words)]
        monkeypatch.setattr(sys, "argv", argv)
        return main()

    return run


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A folder with a model, its map and its frames."""
    graph.save(ir.from_onnx_text(DRIVER), tmp_path / "in.onnx")
    (tmp_path / "map.toml").write_text(DRIVER_MAP)
    write_frames(tmp_path / "frames", camera=np.zeros((1, 4), np.float32))
    return tmp_path


@pytest.fixture
def dense(files: Path) -> Path:
    """The folder with a model that has a layer to quantize."""
    model = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        "dense (float[4,16] camera) => (float[4,32] plan) {"
        ' ["/backbone/Relu"] a = Relu(camera)\n'
        ' ["/plan_head/MatMul"] plan = MatMul(a, w) }'
    )
    draws = np.random.default_rng(0).normal(size=(16, 32)).astype(np.float32)
    weight = rewrite.add_constant(model.graph, draws, "w")
    model.graph[1].replace_input_with(1, weight)
    graph.save(model, files / "dense.onnx")
    camera = np.random.default_rng(1).normal(size=(4, 16)).astype(np.float32)
    shutil.rmtree(files / "frames")
    write_frames(files / "frames", camera=camera)
    return files


def strict(text: str) -> Any:
    """Read JSON as programs do: it knows neither NaN nor Infinity."""

    def refuse(word: str) -> None:
        raise ValueError(f"{word} is not JSON")

    return json.loads(text, parse_constant=refuse)


def write_frames(folder: Path, **arrays: np.ndarray) -> None:
    """Write one scene of two frames."""
    folder.mkdir()
    for index in range(2):
        moved = {
            name: array + array.dtype.type(index) for name, array in arrays.items()
        }
        np.savez(folder / f"{index:06d}.npz", **moved)
    (folder / "scenes.json").write_text('{"scenes": [0]}')
