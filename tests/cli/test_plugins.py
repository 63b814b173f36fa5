"""Graphs with plugins of TensorRT: their shapes, their ranges, and files of ours."""

from pathlib import Path

import numpy as np
import pytest

from me2e_compress import graph
from tests.support.command import Cli
from tests.support.frames import record
from tests.support.plugins import exported

FRAME = {
    "image": np.ones((1, 16, 8, 8), np.float32),
    "angle": np.full(1, 30, np.float32),
    "center": np.full(2, 4, np.float32),
    "lidar": np.tile(2 * np.eye(4, dtype=np.float32), (1, 6, 1, 1)),
}
CACHE = "TRT-100700-EntropyCalibration2\n" + "".join(
    f"{name}: 3c010204\n" for name in ("image", "again", "turned", "y")
)


@pytest.fixture
def plugins(tmp_path: Path) -> Path:
    """bare.onnx and shaped.onnx: without and with value_info for the plugins."""
    graph.save(exported(shapes=False), tmp_path / "bare.onnx")
    graph.save(exported(shapes=True), tmp_path / "shaped.onnx")
    record(tmp_path / "frames", [FRAME] * 4)
    return tmp_path


@pytest.mark.usefixtures("plugins")
def test_plugins_run_where_nobody_has_their_library(cli: Cli) -> None:
    said = cli.done(
        "compress bare.onnx -r exact -o bare-small.onnx --verify-frames 0"
    ).err
    assert "2 plugin nodes (RotateTRT2, InverseTRT) tell no shape" in " ".join(
        said.split()
    )
    how = "-r full --frames frames --floor 0"
    cli.done(f"compress shaped.onnx {how} -o small.onnx")
    cli.done("compare shaped.onnx small.onnx frames")


def test_ranges_of_tensorrt_make_int8_of_a_plugin_that_nobody_runs(
    cli: Cli, plugins: Path
) -> None:
    unknown = graph.load(plugins / "shaped.onnx")
    unknown.graph[1].op_type = "VendorsOwn"
    graph.save(unknown, plugins / "unknown.onnx")
    (plugins / "trt.cache").write_text(CACHE)

    said = cli.refused("calibrate unknown.onnx frames -o r.json")
    assert "calibrate --import CACHE" in said
    cli.done("calibrate shaped.onnx --import trt.cache -o r.json")
    cli.done("compress shaped.onnx -r full --ranges r.json -o int8.onnx")
    int8 = graph.load(plugins / "int8.onnx").graph
    assert "QuantizeLinear" in [node.op_type for node in int8]


def test_what_compress_wrote_can_be_compressed_again(cli: Cli, plugins: Path) -> None:
    cli.done("compress shaped.onnx -r exact -o small.onnx")
    nodes = graph.load(plugins / "small.onnx").graph
    domains = {node.op_type: node.domain for node in nodes}
    assert (domains["RotateTRT2"], domains["InverseTRT"]) == ("", "")
    cli.done("compress small.onnx -r exact -o again.onnx")
