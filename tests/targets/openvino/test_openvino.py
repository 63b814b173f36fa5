"""Int8 for OpenVINO answers what the file says, and lint names where it would not."""

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.graph import array_of
from me2e_compress.runtime.openvino import OpenVinoProvider
from me2e_compress.runtime.session import Session
from me2e_compress.targets.openvino import OpenVino
from tests.support.nets import drawn, parsed, placed

JOINED = """
m (float[1,4,8,8] x, float[1,4,8,8] z, float[16,8,1,1] w, float[8,16,1,1] v)
    => (float[1,8,8,8] y) {
    both = Concat<axis=1>(x, z) n = Neg(both)
    a = Conv(both, w)
    b = Relu(a)
    y = Conv(b, v)
}
"""
SHAPES = {"w": (16, 8, 1, 1), "v": (8, 16, 1, 1)}


def answers(model: ir.Model) -> float:
    """The dB from what OpenVINO's int8 answers to what the nodes say."""
    random = np.random.default_rng(0)
    frame = {n: random.normal(size=(1, 4, 8, 8)).astype("f") for n in ("x", "z")}
    nodes = Session(model, threads=1).run(frame)["y"].astype(np.float64)
    session = Session(model, threads=1, int8_kernels=True, provider=OpenVinoProvider())
    gap = session.run(frame)["y"].astype(np.float64) - nodes
    return float(10 * np.log10((nodes**2).sum() / max((gap**2).sum(), 1e-30)))


def test_what_it_answers_is_the_file_s_where_tensorrt_s_form_is_not() -> None:
    model = drawn(JOINED, SHAPES)
    ours, theirs = (
        placed(model, target, ends=(-3, 3)) for target in ("openvino", "tensorrt")
    )

    assert answers(ours) > 60 > 30 > answers(theirs)
    grids = {
        str(node.inputs[0].name): [array_of(value) for value in node.inputs[1:]]
        for node in ours.graph
        if node.op_type == "QuantizeLinear" and node.inputs[0] is not None
    }
    assert grids["both"] == [np.float32(3 / 127), np.uint8(128)]
    assert grids["b"] == [np.float32(3 * 127 / 255 / 127), np.uint8(0)]
    assert not [e for e in OpenVino().lint(ours) if e.severity != "warning"]
    (finding,) = [e for e in OpenVino().lint(theirs) if e.severity == "wrong"]
    assert finding.rule == "int8-behind-concat"


PAIR = (
    "s = Constant<value = float {{0.1}}>() z = Constant<value = uint8 {{{}}}>()"
    " q = QuantizeLinear(x, s, z) d = DequantizeLinear(q, s, z) "
)
PAIR_BEHIND = " q2 = QuantizeLinear(t, s, z) y = DequantizeLinear(q2, s, z)"
POOL = "AveragePool<kernel_shape=[3,3], pads=[1,1,1,1], count_include_pad={}{}>({})"
CEIL = ", ceil_mode=1, strides=[2,2]"
PAD = "p = Constant<value = int64[8] {0,0,0,1,0,0,0,1}>() t = Pad(d, p)" + PAIR_BEHIND
SUM = "a = Constant<value = int64[1] {3}>() t = ReduceSum(d, a)" + PAIR_BEHIND
RESIZE = (
    "r = Constant<value = float[4] {{1, 1, 0.5, 0.5}}>()"
    ' y = Resize<mode="linear", antialias={}>(x, , r)'
)
DOUBLE = (
    "k = Constant<value = double {1e-9}>() m = Constant<value = double {1e9}>()"
    " i = Cast<to=11>(x) j = Add(i, k) l = Sub(j, i) n = Mul(l, m) y = Cast<to=1>(n)"
)


@pytest.mark.parametrize(
    ("body", "rule"),
    [
        (PAIR.format(5) + "y = " + POOL.format(1, "", "d"), "zero-point"),
        (PAIR.format(0) + "y = " + POOL.format(1, "", "d"), ""),
        (PAIR.format(5) + SUM, "zero-point"),
        (PAIR.format(5) + PAD, "zero-point"),
        ("y = " + POOL.format(1, CEIL, "x"), "attribute"),
        (RESIZE.format(1), "attribute"),
        (DOUBLE, "type"),
    ],
)
def test_what_it_computes_otherwise_is_named_and_nothing_else(
    body: str, rule: str
) -> None:
    head = '<ir_version: 9, opset_import: ["": 18]> m (float[1,2,8,8] x) => (float y)'
    model = parsed(f"{head} {{ {body} }}")
    x = np.random.default_rng(1).uniform(-2, 20, (1, 2, 8, 8)).astype(np.float32)
    wanted = Session(model, threads=1).run({"x": x})["y"]
    session = Session(model, threads=1, int8_kernels=True, provider=OpenVinoProvider())
    differs = not np.allclose(session.run({"x": x})["y"], wanted, rtol=1e-3, atol=1e-3)

    wrong = {e.rule for e in OpenVino().lint(model) if e.severity == "wrong"}
    assert wrong == ({rule} if rule else set())
    assert differs == bool(rule)
