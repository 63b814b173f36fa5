"""Each rule against central differences, over drawn sizes."""

import re

import numpy as np
import numpy.typing as npt
import onnx_ir as ir
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from me2e_compress import graph
from me2e_compress.runtime.session import Session
from me2e_compress.sensitivity.gradients import RULES, Backward, Tape

Array = npt.NDArray[np.floating]
STEP = {"double": 1e-6, "float": 0.5}
"""Of the differences; what onnxruntime has in float32 alone is linear mostly."""
CLOSE = {"double": 1e-6, "float": 2e-3}

SMOOTH = ("Abs", "Cos", "Exp", "Identity", "LeakyRelu", "Neg", "Relu", "Sigmoid",
          "Sin", "Tanh")  # fmt: skip
POSITIVE = ("Log", "Reciprocal", "Sqrt")
PAIRS = ("Add", "Div", "Max", "Min", "Mul", "Sub", "Sum")

CASES = {
    **{op: f"(double[a,b] x) => (double[a,b] y) {{ y = {op}(x) }}" for op in SMOOTH},
    **{op: f"(double[a,b] p) => (double[a,b] y) {{ y = {op}(p) }}" for op in POSITIVE},
    **{
        op: "(double[a,1,c] x, double[b,c] p) => (double[a,b,c] y)"
        f" {{ y = {op}(x, p) }}"
        for op in PAIRS
    },
    **{
        op: f"(float[a,b] tiny) => (float[a,b] y) {{ y = {op}(tiny) }}"
        for op in ("Erf", "Gelu", "Softplus")
    },
    "Pow": "(double[a,b] p) => (double[a,b] y) <double e = {3.0}> { y = Pow(p, e) }",
    "Mod": "(double[a,b] x) => (double[a,b] y) <double e = {0.7}>"
    " { y = Mod<fmod=1>(x, e) }",
    "Clip": "(double[a,b] x) => (double[a,b] y) <double l = {-0.5}, double h = {0.5}>"
    " { y = Clip(x, l, h) }",
    "Cast": "(double[a,b] x) => (double[a,b] y) { y = Cast<to=11>(x) }",
    "Where": "(double[a,b] x, double[b] p) => (double[a,b] y) <double e = {0.0}>"
    " { m = Greater(x, e) y = Where(m, x, p) }",
    "ReduceSum": "(double[a,b,c] x) => (double[a,c] y) <int64[1] i = {1}>"
    " { y = ReduceSum<keepdims=0>(x, i) }",
    "ReduceSum-products": "(double[a,b,c] x, double[b,1] w) => (double[a,c] y)"
    " <int64[1] i = {1}> { s = Mul(x, x) m = Mul(s, w)"
    " y = ReduceSum<keepdims=0>(m, i) }",
    "ReduceSum-narrow": "(double[a,1,c] x, double[b,c] w) => (double[a,c] y)"
    " <int64[1] i = {1}> { m = Mul(x, w) y = ReduceSum<keepdims=0>(m, i) }",
    "ReduceMean": "(double[a,b,c] x) => (double[a,b,1] y)"
    " { y = ReduceMean<axes=[-1]>(x) }",
    "ReduceMax": "(double[a,b,c] x) => (double[a,c] y)"
    " { y = ReduceMax<axes=[1], keepdims=0>(x) }",
    "ReduceMin": "(double[a,b] x) => (double[1,1] y) { y = ReduceMin(x) }",
    "ReduceL2": "(float[a,b] tiny) => (float[a,1] y) { y = ReduceL2<axes=[1]>(tiny) }",
    "CumSum": "(double[a,b] x) => (double[a,b] y) <int64 i = {1}>"
    " { y = CumSum<exclusive=1>(x, i) }",
    "Softmax": "(double[a,b,c] x) => (double[a,b,c] y) { y = Softmax<axis=1>(x) }",
    "LogSoftmax": "(double[a,b] x) => (double[a,b] y) { y = LogSoftmax(x) }",
    "LayerNormalization": "(double[a,b,c] x, double[c] w) => (double[a,b,c] y)"
    " { y = LayerNormalization<axis=-1>(x, w) }",
    "MatMul": "(double[a,1,b,c] x, double[b,c,a] w) => (double[a,b,b,a] y)"
    " { y = MatMul(x, w) }",
    "Gemm": "(double[b,a] x, double[c,b] w, double[c] z) => (double[a,c] y)"
    " { y = Gemm<transA=1, transB=1, alpha=0.5, beta=2.0>(x, w, z) }",
    "Reshape": "(double[a,b,c] x) => (double[a,n] y) <int64[2] s = {0, -1}>"
    " { y = Reshape(x, s) }",
    "Flatten": "(double[a,b,c] x) => (double[a,n] y) { y = Flatten(x) }",
    "Squeeze": "(double[a,1,c] x) => (double[a,c] y) <int64[1] i = {1}>"
    " { y = Squeeze(x, i) }",
    "Unsqueeze": "(double[a,c] x) => (double[a,1,c] y) <int64[1] i = {1}>"
    " { y = Unsqueeze(x, i) }",
    "Transpose": "(double[a,b,c] x) => (double[c,a,b] y)"
    " { y = Transpose<perm=[2,0,1]>(x) }",
    "Expand": "(double[a,1] x) => (double[b,a,c] y) <int64[3] s = {b, a, c}>"
    " { y = Expand(x, s) }",
    "Tile": "(double[a,b] x) => (double[n,m] y)"
    " <int64[2] r = {2, 3}> { y = Tile(x, r) }",
    "Concat": "(double[a,b] x, double[a,c] w) => (double[a,n] y)"
    " { y = Concat<axis=-1>(x, w) }",
    "Split": "(double[a,4] x) => (double[a,3] y) <int64[2] s = {1, 3}>"
    " { o, y = Split<axis=1>(x, s) }",
    "Slice": "(double[4,5] x) => (double[2,2] y)"
    " <int64[2] s = {1, 4}, int64[2] e = {3, -9}, int64[2] i = {0, 1},"
    " int64[2] t = {1, -3}>"
    " { y = Slice(x, s, e, i, t) }",
    "Gather": "(double[a,3,c] x) => (double[a,2,2,c] y) <int64[2,2] i = {0, 2, -1, 0}>"
    " { y = Gather<axis=1>(x, i) }",
    "Gather-one": "(double[a,3,c] x) => (double[a,c] y) <int64 i = {-2}>"
    " { y = Gather<axis=1>(x, i) }",
    "Gather-found": "(double[a,3] x) => (double[a,1] y)"
    " { f = Flatten<axis=0>(x) m = ArgMax<axis=1, keepdims=0>(f) z = Sub(m, m)"
    " y = Gather<axis=1>(x, z) }",
    "GatherElements": "(double[a,3] x) => (double[a,2] y)"
    " <int64[1] two = {2}> { l, o = TopK<axis=1, largest=0>(x, two)"
    " y = GatherElements<axis=1>(x, o) }",
    "GatherND": "(double[3,b] x) => (double[2,b] y) <int64[2,1] i = {2, 2}>"
    " { y = GatherND(x, i) }",
    "ScatterND": "(double[3,b] x, double[2,b] w) => (double[3,b] y)"
    " <int64[2,1] i = {2, 0}> { y = ScatterND(x, i, w) }",
    "ScatterND-add": "(double[3,b] x, double[2,b] w) => (double[3,b] y)"
    ' <int64[2,1] i = {2, 2}> { y = ScatterND<reduction="add">(x, i, w) }',
    "ScatterElements": "(double[2,3] x, double[2,1] w) => (double[2,3] y)"
    " <int64[2,1] i = {2, 0}> { y = ScatterElements<axis=1>(x, i, w) }",
    "ScatterElements-add": "(double[2,3] x, double[2,1] w) => (double[2,3] y)"
    ' <int64[2,1] i = {2, 0}> { y = ScatterElements<axis=1, reduction="add">'
    "(x, i, w) }",
    "TopK": "(double[a,3] x) => (double[a,2] y)"
    " <int64[1] two = {2}> { y, o = TopK(x, two) }",
    "Pad": "(double[a,b] x) => (double[n,m] y) <int64[4] p = {1, 0, 2, 3}>"
    " { y = Pad(x, p) }",
    "MaxPool": "(double[a,b,5,4] x) => (double[a,b,3,2] y)"
    " { y = MaxPool<kernel_shape=[3,3], strides=[2,2], pads=[1,1,1,0]>(x) }",
    "AveragePool": "(float[a,b,5,4] x) => (float[a,b,2,2] y)"
    " { y = AveragePool<kernel_shape=[3,2], strides=[2,2]>(x) }",
    "GlobalAveragePool": "(float[a,b,c,2] x) => (float[a,b,1,1] y)"
    " { y = GlobalAveragePool(x) }",
    "BatchNormalization": "(double[a,b,c] x, double[b] s, double[b] z, double[b] m,"
    " double[b] p) => (double[a,b,c] y) { y = BatchNormalization(x, s, z, m, p) }",
    "InstanceNormalization": "(float[a,b,4] tiny, float[b] s, float[b] z)"
    " => (float[a,b,4] y) { y = InstanceNormalization(tiny, s, z) }",
    "Conv": "(float[a,4,5,4] x, float[6,2,3,3] k) => (float[a,6,5,3] y)"
    " { y = Conv<pads=[1,0,1,1], group=2>(x, k) }",
    "Conv-strided": "(float[a,2,6,5] x, float[3,2,3,2] k) => (float[a,3,n,m] y)"
    " { y = Conv<strides=[2,3], pads=[1,0,0,1], dilations=[1,2]>(x, k) }",
    "ConvTranspose": "(float[a,4,3,2] x, float[4,3,3,2] k) => (float[a,6,n,m] y)"
    " { y = ConvTranspose<strides=[2,1], pads=[1,0,0,1], group=2>(x, k) }",
    "Resize": "(float[a,b,2,3] x) => (float[a,b,5,4] y) <int64[4] s = {a, b, 5, 4}>"
    ' { y = Resize<mode="linear", coordinate_transformation_mode="half_pixel">'
    "(x, , , s) }",
    "GridSample": "(double[a,b,4,3] x, double[a,2,3,2] x2) => (double[a,b,2,3] y)"
    ' { y = GridSample<mode="linear">(x, x2) }',
    "GridSample-aligned": "(double[a,b,4,3] x, double[a,2,3,2] x2)"
    " => (double[a,b,2,3] y)"
    ' { y = GridSample<mode="linear", align_corners=1>(x, x2) }',
}  # fmt: skip


def made(text: str, sizes: tuple[int, int, int]) -> ir.Model:
    """Read a case with its sizes in place of a, b and c."""
    a, b, c = map(str, sizes)
    found = {"a": a, "b": b, "c": c}
    text = re.sub(r"(?<=[\[{ ,])([abc])(?=[\],}])", lambda m: found[m[1]], text)
    text = re.sub(r"^\(", "net (", text)
    opset = 20 if "Gelu" in text or "GridSample" in text else 17
    model = ir.from_onnx_text(f'<ir_version: 9, opset_import: ["" : {opset}]> {text}')
    graph.infer_shapes(model)
    return model


def feeds(model: ir.Model, seed: int) -> dict[str, Array]:
    random = np.random.default_rng(seed)
    found: dict[str, Array] = {}
    for value in model.graph.inputs:
        shape, kind = graph.static_shape(value), value.dtype
        assert shape is not None
        assert kind is not None
        drawn = random.standard_normal(shape)
        if value.name == "p":
            drawn = np.abs(drawn) + 0.5
        found[str(value.name)] = drawn.astype(kind.numpy())
    return found


def backward(model: ir.Model, names: list[str]) -> ir.Model:
    """Return a copy that gives the gradient of each of these inputs, for signs v."""
    copy = model.clone()
    main, y = copy.graph, copy.graph.outputs[0]
    values = {value.name: value for value in main.inputs}
    wanted = {values[name] for name in names}
    for node in main:
        wanted.update(node.outputs)
    nodes, tape = list(main), Tape(copy)
    signs = ir.Value(name="v", shape=y.shape, type=y.type)
    main.inputs.append(signs)
    found = Backward(tape, wanted, 1 << 40)
    found.seed(y, signs)
    for node in reversed(nodes):
        found.pass_through(node)
    assert not found.missing
    for name in names:
        gradient = tape.op("Identity", [found.found[values[name]]])
        gradient.name, gradient.type = f"d_{name}", values[name].type
        main.outputs.append(gradient)
    return copy


def differences(session: Session, fed: dict[str, Array], name: str, v: Array) -> Array:
    """Measure the slope of v.y in every direction of an input."""
    step = STEP["double" if fed[name].dtype == np.float64 else "float"]
    step = 1e-2 if name == "tiny" else step
    found = np.zeros(fed[name].shape)
    for at in np.ndindex(found.shape):
        ends = []
        for sign in (1, -1):
            moved = fed[name].copy()
            moved[at] += sign * step
            (y, *_) = session.run({**fed, name: moved}).values()
            ends.append(float(np.sum(v * np.asarray(y, np.float64))))
        found[at] = (ends[0] - ends[1]) / (2 * step)
    return found


WEIGHTS = {"BatchNormalization": "x", "LayerNormalization": "x", "Pow": "p",
           "InstanceNormalization": "tiny", "Mod": "x"}  # fmt: skip
"""Operators of which the gradient of one input alone is known."""


@pytest.mark.parametrize("case", CASES)
@settings(max_examples=4, deadline=None, phases=[Phase.explicit, Phase.generate])
@given(st.tuples(*[st.integers(1, 3)] * 3), st.integers(0, 99))
def test_a_rule_gives_the_slopes_that_differences_show(
    case: str, sizes: tuple[int, int, int], seed: int
) -> None:
    model = made(CASES[case], sizes)
    fed = feeds(model, seed)
    names = [name for name in fed if name != "k"]
    names = [WEIGHTS[case]] if case in WEIGHTS else names
    whole = backward(model, names)
    shape = graph.static_shape(model.graph.outputs[0])
    assert shape is not None
    kind = model.graph.outputs[0].dtype
    assert kind is not None
    v = np.random.default_rng(seed + 1).choice([-1.0, 1.0], shape).astype(kind.numpy())

    got = Session(whole, threads=1).run({**fed, "v": v})

    session = Session(model, threads=1)
    for name in names:
        close = CLOSE["double" if fed[name].dtype == np.float64 else "float"]
        expected = differences(session, fed, name, v)
        found = np.asarray(got[f"d_{name}"], np.float64)
        assert found == pytest.approx(expected, abs=close, rel=close)


def test_every_rule_has_a_case() -> None:
    assert {each.split("-")[0] for each in CASES} == {*RULES, "Split"}


@pytest.mark.parametrize(
    ("text", "shares"),
    [
        ("y = ReduceMax<axes=[1]>(x)", [1 / 3, 1 / 3, 0, 1 / 3]),
        ("y = ReduceMin<axes=[1]>(x)", [0, 0, 1, 0]),
        ("e = Relu(x) y = Max(x, e)", [1, 1, 0, 1]),
    ],
)
def test_those_that_are_the_extreme_together_share_its_gradient(
    text: str, shares: list[float]
) -> None:
    size = 1 if "axes" in text else 4
    model = made(f"(double[1,4] x) => (double[1,{size}] y) {{ {text} }}", (1, 1, 1))
    x, v = np.array([[2.0, 2.0, -1.0, 2.0]]), np.ones((1, size))

    found = Session(backward(model, ["x"]), threads=1).run({"x": x, "v": v})["d_x"]

    assert found[0] == pytest.approx(shares)
