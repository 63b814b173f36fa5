"""What a user is told where exactness could not be proven."""

from pathlib import Path

import onnx_ir as ir
import pytest

from me2e_compress import graph
from tests.cli.conftest import Command, strict

HEAD = '<ir_version: 9, opset_import: ["" : 17, "trt.plugins" : 1]>\n'
PLUGIN = """m (float[1,4] camera) => (float[1,4] plan) {
    ["/backbone/Identity"] a = Identity(camera)
    ["/occ_head/Rotate"] b = trt.plugins.Rotate<mode=1>(a)
    ["/plan_head/Neg"] plan = Neg(b)
}"""
OPEN = """m (float[n,4] camera, float[1,4] other) => (float[n,4] plan) {
    ["/backbone/Identity"] a = Identity(camera)
    ["/plan_head/Add"] plan = Add(a, other)
}"""


@pytest.fixture
def compress(command: Command, tmp_path: Path) -> Command:
    """Write a graph and compress it by an exact recipe; give the exit code."""

    def run(*words: str | Path) -> int:
        text, *rest = words
        graph.save(ir.from_onnx_text(HEAD + str(text)), tmp_path / "in.onnx")
        files = tmp_path / "in.onnx", "-o", tmp_path / "out.onnx"
        return command("compress", *files, "-r", "exact", *rest)

    return run


def test_what_cannot_be_run_is_not_written(
    compress: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert compress(PLUGIN) == 1
    *_, line = capsys.readouterr().err.splitlines()
    assert "not proven that import-normalize, eliminate-redundant left" in line
    assert "no operator trt.plugins::Rotate (node '/occ_head/Rotate')" in line
    assert line.endswith("nothing is written, --unproven writes it nevertheless")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.onnx"]


def test_what_cannot_be_run_is_written_on_demand(
    compress: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert compress(PLUGIN, "--unproven", "--json") == 0
    left = [node.op_type for node in graph.load(tmp_path / "out.onnx").graph]
    assert left == ["Rotate", "Neg"]
    found = strict(capsys.readouterr().out)
    (check,) = found["verifications"]
    assert not check["proven"]
    assert "trt.plugins::Rotate" in check["skipped"]


def test_nobody_is_told_of_a_proof_that_nobody_asked_for(
    compress: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    assert compress(OPEN, "--verify-frames", "0") == 0
    shown = " ".join(capsys.readouterr().out.split())
    said = "not proven: import-normalize, eliminate-redundant: no frame was asked for"
    assert said in shown
    assert "every output is the same" not in shown


def test_an_open_dimension_is_proven_at_drawn_sizes(
    compress: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    assert compress(OPEN) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "every output is the same (synthetic, n=2" in shown
    assert "not proven" not in shown
