"""A model that is newer than onnxruntime, on the command line."""

import json
from pathlib import Path

import onnx_ir as ir
import pytest

from tests.cli.conftest import Command
from tests.graph.test_opset import written


@pytest.fixture
def new(tmp_path: Path) -> Path:
    path = written(tmp_path, "y = Relu(x)")
    model = ir.load(path)
    del model.graph.inputs[1:]
    path.write_bytes(ir.to_proto(model).SerializeToString())
    return path


def test_compress_says_what_was_changed(
    command: Command, new: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = new.with_name("small.onnx")
    assert command("compress", new, "-r", "exact", "-o", small) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "IR version 14 became 13, opset 28 became 26: onnxruntime reads no" in said
    report = json.loads(new.with_name("small.report.json").read_text())
    assert "opset 28 became 26" in report["source"]["read_as"]


def test_inspect_says_what_was_changed(
    command: Command, new: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("inspect", new) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "opset 26 and trt (IR version 14 became 13, opset 28 became 26)" in said
