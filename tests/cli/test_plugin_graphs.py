"""Plugin graphs as exporters write them, on the command line."""

from pathlib import Path

import numpy as np
import pytest

from me2e_compress import graph
from tests.cli.conftest import Command
from tests.frames import record
from tests.plugins import exported

CACHE = """TRT-100700-EntropyCalibration2
image: 3c010204
again: 3c010204
turned: 3c010204
y: 3c010204
"""


@pytest.fixture
def plugins(tmp_path: Path) -> Path:
    """bare.onnx and shaped.onnx: without and with value_info for the plugins."""
    graph.save(exported(shapes=False), tmp_path / "bare.onnx")
    graph.save(exported(shapes=True), tmp_path / "shaped.onnx")
    return tmp_path


@pytest.mark.parametrize("name", ["inspect", "plan", "lint"])
def test_a_graph_without_shapes_for_its_plugins_opens_and_says_so(
    command: Command, plugins: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    assert command(name, plugins / "bare.onnx") == 0
    said = "".join(capsys.readouterr().out.split())
    assert "value_info" in said


def test_compress_says_it_too(
    command: Command, plugins: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = ("-r", "exact", "-o", plugins / "small.onnx", "--unproven")
    assert command("compress", plugins / "bare.onnx", *made) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "2 plugin nodes (RotateTRT2, InverseTRT) tell no shape" in said


@pytest.mark.parametrize("name", ["inspect", "plan"])
def test_with_value_info_nothing_is_said(
    command: Command, plugins: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    assert command(name, plugins / "shaped.onnx") == 0
    assert "value_info" not in "".join(capsys.readouterr().out.split())


FRAME = {
    "image": np.ones((1, 16, 8, 8), np.float32),
    "angle": np.full(1, 30, np.float32),
    "center": np.full(2, 4, np.float32),
    "lidar": np.tile(2 * np.eye(4, dtype=np.float32), (1, 6, 1, 1)),
}


def test_plugins_run_where_nobody_has_their_library(
    command: Command, plugins: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = record(plugins / "frames", [FRAME] * 4)
    small = plugins / "small.onnx"
    made = ("-r", "full", "--frames", frames, "--floor", "0", "-o", small)

    assert command("compress", plugins / "shaped.onnx", *made) == 0, capsys.readouterr()
    assert command("compare", plugins / "shaped.onnx", small, frames) == 0


def test_calibrate_names_the_way_to_int8_without_running_the_graph(
    command: Command, plugins: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = record(plugins / "frames", [FRAME])
    unknown = graph.load(plugins / "shaped.onnx")
    unknown.graph[1].op_type = "VendorsOwn"
    graph.save(unknown, plugins / "unknown.onnx")

    words = (plugins / "unknown.onnx", frames, "-o", plugins / "r.json")

    assert command("calibrate", *words) == 1
    assert "calibrate --import CACHE" in " ".join(capsys.readouterr().err.split())


def test_ranges_of_tensorrt_make_a_plugin_graph_int8(
    command: Command, plugins: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, ranges = plugins / "shaped.onnx", plugins / "r.json"
    (plugins / "trt.cache").write_text(CACHE)
    words = ("--import", plugins / "trt.cache", "-o", ranges)
    assert command("calibrate", model, *words) == 0, capsys.readouterr().err
    made = ("-r", "full", "--ranges", ranges, "-o", plugins / "int8.onnx")
    assert command("compress", model, *made) == 0, capsys.readouterr().err
    small = graph.load(plugins / "int8.onnx")
    assert "QuantizeLinear" in [node.op_type for node in small.graph]


def test_what_compress_wrote_can_be_compressed_again(
    command: Command, plugins: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small, again = plugins / "small.onnx", plugins / "again.onnx"
    made = ("-r", "exact", "-o")
    assert command("compress", plugins / "shaped.onnx", *made, small) == 0
    domains = {node.op_type: node.domain for node in graph.load(small).graph}
    assert (domains["RotateTRT2"], domains["InverseTRT"]) == ("", "")
    assert command("compress", small, *made, again) == 0, capsys.readouterr().err
