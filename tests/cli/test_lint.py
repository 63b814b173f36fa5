import json
from pathlib import Path

import onnx_ir as ir
import pytest

from me2e_compress import graph
from tests.cli.conftest import Command
from tests.docs.documents import faults
from tests.targets.onnxruntime.lowered import MATMUL_RELU

TWIST = (
    '<ir_version: 9, opset_import: ["" : 17, "own" : 1]>'
    "m (float[2] x) => (float[2] y) { a = own.Twist(x) b = own.Twist(a)"
    " c = own.Twist(b) d = own.Twist(c) y = own.Twist(d) }"
)


@pytest.fixture
def twisted(tmp_path: Path) -> Path:
    path = tmp_path / "twist.onnx"
    graph.save(ir.from_onnx_text(TWIST), path)
    return path


def test_a_clean_graph_passes_for_both_targets(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for target in ("tensorrt", "onnxruntime"):
        assert command("lint", dense / "dense.onnx", "--target", target) == 0
        assert f"for {target}: 0 errors, 0 warnings" in capsys.readouterr().out


def test_what_would_be_refused_is_listed_and_fails(
    command: Command, twisted: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("lint", twisted) == 1

    said = capsys.readouterr()
    assert "error plugin: 2 more" in said.out
    (line,) = said.err.strip().splitlines()
    assert "tensorrt refuses it, 5 errors; plugin 'a': own::Twist is neither" in line


def test_the_verbose_see_every_node(
    command: Command, twisted: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("lint", twisted, "-v") == 1

    assert "more" not in capsys.readouterr().out


def test_findings_for_programs(
    command: Command, twisted: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("lint", twisted, "--json") == 1

    found = json.loads(capsys.readouterr().out)
    assert faults("lint", found) == []
    assert found["status"] == "refused"
    assert [each["rule"] for each in found["findings"]] == ["plugin"] * 5
    assert found["tensorrt_rtx"] is None


def test_no_such_target(
    command: Command, twisted: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("lint", twisted, "--target", "npu") == 1
    assert "no target 'npu'; there are tensorrt" in capsys.readouterr().err


def test_trt_check_says_what_was_asked_and_of_whom(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("tensorrt_rtx")

    assert command("lint", dense / "dense.onnx", "--trt-check") == 0

    said = capsys.readouterr().out
    assert "TensorRT-RTX 1" in said
    assert "parsed, built for SM86" in said


def test_trt_check_is_not_for_other_targets(
    command: Command, twisted: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--target", "onnxruntime", "--trt-check")

    assert command("lint", twisted, *words) == 1
    assert "--trt-check is for tensorrt, not for onnx" in capsys.readouterr().err


def test_int8_that_onnxruntime_runs_in_float_is_named(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    graph.save(ir.from_onnx_text(MATMUL_RELU), tmp_path / "m.onnx")

    assert (
        command("lint", tmp_path / "m.onnx", "--target", "onnxruntime", "--json") == 0
    )

    (found,) = json.loads(capsys.readouterr().out)["findings"]
    assert (found["rule"], found["node"]) == ("float-kernel", "/head/fc")
