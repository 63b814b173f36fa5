"""Graphs of old opsets, and int8 of others: one line names what is in the way."""

from pathlib import Path

import numpy as np
import pytest

from me2e_compress import graph
from tests.command import Cli
from tests.nets import parsed, save_text, stored

HEAD = '<ir_version: 3, opset_import: ["" : {opset}]> m (float[4,16] camera{more})'
ADDED = HEAD.format(opset=6, more="") + (
    " => (float[4,16] plan) <float[4] w = {1, 2, 3, 4}>"
    " { r = Relu(camera) plan = Add<axis=0, broadcast=1>(r, w) }"
)
LINES = (
    "inspect m.onnx",
    "plan m.onnx",
    "compress m.onnx -r exact -o out.onnx",
    "compress m.onnx -r full --frames frames -o out.onnx",
    "compare m.onnx m.onnx frames",
    "sensitivity m.onnx frames -o out.toml",
)


@pytest.mark.parametrize("line", LINES)
def test_operators_that_nothing_runs_any_more_are_named(
    cli: Cli, dense: Path, line: str
) -> None:
    save_text(dense / "m.onnx", ADDED)

    assert "m.onnx: opset 6: onnxruntime has no Add of before" in cli.refused(line)


def test_an_old_opset_is_no_fault_where_its_operators_run(
    cli: Cli, dense: Path
) -> None:
    text = HEAD.format(opset=6, more="") + " => (float[4,16] plan) {plan=Relu(camera)}"
    save_text(dense / "m.onnx", text)

    assert "opset 6 became 13" in cli.done("compress m.onnx -v -r exact -o o.onnx").out


@pytest.mark.parametrize("line", [LINES[1], LINES[3] + " --rules paper"])
def test_what_keeps_the_opset_too_old_for_int8_is_named_and_exact_is_left(
    cli: Cli, dense: Path, line: str
) -> None:
    text = HEAD.format(opset=11, more=", float[16,32] w") + (
        " => (float[4,32] plan)"
        ' { a = MatMul(camera, w) ["pick"] plan = Hardmax<axis=1>(a) }'
    )
    graph.save(
        stored(parsed(text), {"w": np.eye(16, 32, dtype=np.float32)}), dense / "m.onnx"
    )

    said = cli.refused(line)
    assert "is of 11: Hardmax 'pick' stays as it is" in said
    assert "-r exact writes a graph without int8" in said
    cli.done("compress m.onnx -r exact -o exact.onnx")


@pytest.mark.parametrize(
    ("zero", "offered"), [("int8 z = {0}", True), ("int8 z = {3}", False),
                          ("uint8 z = {0}", False), ("uint8 z = {128}", False)]
)  # fmt: skip
def test_lower_int8_is_offered_of_what_it_takes_alone(
    cli: Cli, dense: Path, zero: str, offered: bool
) -> None:
    save_text(dense / "m.onnx", "m (float[4,16] camera) => (float[4,16] plan)"
              f" <float s = {{0.1}}, {zero}> {{ q = QuantizeLinear(camera, s, z)"
              " plan = DequantizeLinear(q, s, z) }")  # fmt: skip

    assert ("lower-int8" in cli.refused(LINES[3])) is offered
    lowered = cli("compress m.onnx --passes lower-int8 --frames frames -o low.onnx")
    assert (lowered.code == 0) is offered
