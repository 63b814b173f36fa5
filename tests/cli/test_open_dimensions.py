"""Models whose batch is open, on the command line."""

import json
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph, rewrite
from tests.cli.conftest import Command
from tests.frames import record


@pytest.fixture
def batched(tmp_path: Path) -> Path:
    """A convolution and a layer over an open batch, and frames of one."""
    model = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        "m (float[batch,16,8,8] image, float[32,16,3,3] w, float[64,32] l)"
        " => (float[batch,64] y) <int64[2] flat = {-1, 32}>"
        " { a = Conv(image, w) p = GlobalAveragePool(a)"
        " f = Reshape(p, flat) y = Gemm<transB=1>(f, l) }"
    )
    draws = np.random.default_rng(0)
    for value in list(model.graph.inputs[1:]):
        shape = graph.static_shape(value) or ()
        array = draws.normal(size=shape).astype(np.float32)
        model.graph.inputs.remove(value)
        value.replace_all_uses_with(
            rewrite.add_constant(model.graph, array, str(value.name))
        )
    graph.save(model, tmp_path / "m.onnx")
    frames = [{"image": draws.normal(size=(1, 16, 8, 8)).astype(np.float32)}] * 2
    record(tmp_path / "frames", frames)
    return tmp_path


def test_inspect_shows_open_dimensions_and_says_what_they_cost(
    command: Command, batched: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("inspect", batched / "m.onnx") == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "[batch,16,8,8]" in shown
    assert "2 nodes not counted: 1 Conv (open shape), 1 Gemm (open shape)" in shown
    assert "--set-dim NAME=SIZE for batch" in shown


def test_inspect_counts_once_the_batch_has_a_size(
    command: Command, batched: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("inspect", batched / "m.onnx", "--set-dim", "batch=2", "--json")
    assert command(*words) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["macs"] == 2 * 6 * 6 * 32 * 16 * 9 + 2 * 64 * 32
    assert found["inputs"][0]["shape"] == "[2,16,8,8]"


def test_plan_calibrate_and_compress_agree_on_the_graph_of_one_size(
    command: Command, batched: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, ranges = batched / "m.onnx", batched / "r.json"
    size = ("--set-dim", "batch=1")
    made = ("--ranges", ranges, "-o", batched / "small.onnx")
    assert command("plan", model, *size) == 0
    assert command("calibrate", model, batched / "frames", "-o", ranges, *size) == 0
    found = command("compress", model, "-r", "full", *made, *size)
    assert found == 0, capsys.readouterr().err
    small = graph.load(batched / "small.onnx")
    assert str(small.graph.inputs[0].shape) == "[1,16,8,8]"


def test_search_and_sensitivity_write_the_sizes_into_the_recipe(
    command: Command, batched: Path
) -> None:
    model, frames = batched / "m.onnx", batched / "frames"
    asked = {"search": ("--max-mb", "1"), "sensitivity": ("--limit", "9")}
    for name, limit in asked.items():
        found, made = batched / f"{name}.toml", batched / f"{name}.onnx"
        sized = (*limit, "--set-dim", "batch=1")
        assert command(name, model, frames, "-o", found, *sized) == 0
        given = ("--frames", frames, "-o", made)
        assert command("compress", model, "-r", found, *given) == 0
        assert str(graph.load(made).graph.inputs[0].shape) == "[1,16,8,8]"


def test_lint_reads_the_graph_of_one_size(
    command: Command, batched: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("lint", batched / "m.onnx", "--set-dim", "batch=1") == 0
    assert command("lint", batched / "m.onnx", "--set-dim", "rows=1") == 1
    assert "no open dimension is called 'rows'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("batch", "write NAME=SIZE, e.g. batch=1"),
        ("batch=x", "write NAME=SIZE, e.g. batch=1"),
        ("batch=0", "batch=0 must be 1 or more"),
        ("rows=1", "no open dimension is called 'rows'; there is batch"),
    ],
)
def test_a_bad_size_is_one_line(
    command: Command,
    batched: Path,
    capsys: pytest.CaptureFixture[str],
    text: str,
    message: str,
) -> None:
    assert command("inspect", batched / "m.onnx", "--set-dim", text) == 1
    assert message in capsys.readouterr().err
