"""Graphs whose answers jump: what is proven piece by piece, and what is refused."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.base.errors import VerificationError
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.graph import infer_shapes
from me2e_compress.manager import PassManager, Verification, equivalence, recipe
from me2e_compress.manager.pieces import steps_after_changes
from me2e_compress.manager.verification_inputs import VerificationInputs
from me2e_compress.passes.attach_bodies import AttachBodies
from me2e_compress.passes.base import Context
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.runtime.frames import Frame
from tests.manager.transformer import transformer
from tests.passes.small import EVERYTHING, read
from tests.passes.test_attach_bodies import ALIKE
from tests.support.frames import record

SHIFT = 4e-6
"""What a pass that only rounds moves a sum by, of numbers up to 255."""

GRAPH = """<ir_version: 9, opset_import: ["" : 19]>
m (float[1,64] x) => (float[k] y, float[n] other)
<float one = {1.0}, int8 z = {0}, float zero = {0.0}, int64[1] three = {3},
 int64[4] grid = {1, 4, 8, 2}, int64[1] flat = {-1}> {
    ["/backbone/Add"] a = Add(x, w)
    STEP
    ["/head/Reshape"] r = Reshape(s, flat)
    ["/head/Tanh"] y = Tanh(r)
    ["/head/Neg"] other = Neg(y)
}"""

QUANTIZED = "q = QuantizeLinear(a, one, z) s = DequantizeLinear(q, one, z)"
BY_RANGE = "q, k, o = DynamicQuantizeLinear(a) s = DequantizeLinear(q, k, o)"
NEAREST = """g = Reshape(a, grid)
    s = GridSample<mode = "nearest", align_corners = 1>(picture, g)"""
STEPS = {
    "QuantizeLinear": (QUANTIZED, 0.5),
    "DynamicQuantizeLinear": (BY_RANGE, 0.5),
    "Round": ("s = Round(a)", 0.5),
    "Floor": ("s = Floor(a)", 0.0),
    "Ceil": ("s = Ceil(a)", 0.0),
    "Sign": ("s = Sign(a)", 0.0),
    "Cast": ("c = Cast<to = 6>(a) s = Cast<to = 1>(c)", 1.0),
    "Greater": ("c = Greater(a, zero) s = Cast<to = 1>(c)", 0.0),
    "LessOrEqual": ("c = LessOrEqual(a, zero) s = Cast<to = 1>(c)", 0.0),
    "TopK": ("v, i = TopK<axis = 1>(a, three) s = Cast<to = 1>(i)", 3.0),
    "GridSample": (NEAREST, -0.5),
}
"""Of each operator a graph, and where its answer jumps."""


def graphs(step: str, shift: float, seed: int = 0) -> tuple[ir.Model, ir.Model, Frame]:
    """A graph, one that rounds otherwise in front of a step, and a frame for both."""
    text, at = STEPS[step]
    draws = np.random.default_rng(seed)
    w = np.ones((1, 64), np.float32)
    x = draws.uniform(-1, 1, (1, 64)).astype(np.float32)
    x[0, ::4] = at - 1 - SHIFT / 2  # crosses with the shift
    x[0, :3] = -1, 254, 199  # from 0 to 255, where one step is 1
    moved = np.full((1, 64), shift, np.float32)
    moved[0, 4] = 0
    if step == "TopK":  # the third is one of two
        x[0, 4] = at - 1
    picture = draws.normal(size=(1, 1, 3, 3)).astype(np.float32)
    before = read(GRAPH.replace("STEP", text), w=w, picture=picture)
    infer_shapes(before)
    after = before.clone()
    _give(after, w=w + moved)
    return before, after, Frame(0, True, {"x": x})


def _give(model: ir.Model, **weights: np.ndarray) -> None:
    for name, array in weights.items():
        model.graph.initializers[name].const_value = ir.tensor(array, name=name)


def verified(before: ir.Model, after: ir.Model, *frames: Frame) -> Verification:
    inputs = VerificationInputs(frames, "recorded")
    return equivalence.verify(("rounds",), before, after, inputs)


@pytest.mark.parametrize("step", STEPS)
def test_rounding_in_front_of_a_step_is_no_breach(step: str) -> None:
    before, after, frame = graphs(step, SHIFT)
    inputs = VerificationInputs([frame], "recorded")
    (left,), (right,) = inputs.run(before), inputs.run(after)
    assert not np.array_equal(left["y"], right["y"])  # it does jump

    check = verified(before, after, frame)

    assert check.unproven is None
    assert check.unsteady == ()
    assert check.errors == {"y": 0.0, "other": 0.0}
    assert "piece by piece" in check.remarks[0]


@pytest.mark.parametrize("step", STEPS)
def test_more_than_rounding_in_front_of_a_step_is_one(step: str) -> None:
    before, after, frame = graphs(step, SHIFT)
    _give(after, w=np.random.default_rng(2).uniform(0, 3, (1, 64)).astype(np.float32))

    check = verified(before, after, frame)

    assert not check.passed
    assert check.unsteady == ()


@pytest.mark.parametrize("step", ["QuantizeLinear", "Round"])
def test_a_breach_is_one_however_far_rounding_moves_what_is_behind_it(
    step: str,
) -> None:
    before, after, frame = graphs(step, 0.1)
    frame.arrays["x"][0, 4::4] = -0.5  # where to rounding decides

    check = verified(before, after, frame)

    inputs = VerificationInputs([frame], "recorded")
    answers, apart = list(inputs.run(before)), {"y": check.errors["y"]}
    assert equivalence.unsteady_outputs(before, answers, inputs, apart) == ("y",)
    assert not check.passed


CANCELLED = """<ir_version: 9, opset_import: ["" : 19]>
m (float[1,64] x) => (float[1,64] y, float[1,64] other) {
    ["/head/First"] a = Add(x, k)
    ["/head/Second"] b = Sub(a, l)
    c = Round(b)
    d = Neg(x)
    ["/head/Sum"] e = Add(d, w)
    r = Round(e)
    y = Mul(c, b)
    other = Mul(r, d)
}"""


@pytest.mark.parametrize(("shift", "passed"), [(0.0, True), (0.02, False)])
def test_a_piece_that_rounding_alone_moves_as_far_is_unsteady_not_wrong(
    shift: float, passed: bool
) -> None:
    w, shifts = np.ones((1, 64), np.float32), (0.0, shift)
    before, after = (
        read(CANCELLED, k=w * large, l=w * large + moved, w=w + SHIFT * (large > 1e4))
        for large, moved in zip((1e4, 3e4), shifts, strict=True)
    )
    for model in (before, after):
        infer_shapes(model)
    x = np.random.default_rng(3).uniform(0, 1, (1, 64)).astype(np.float32)

    check = verified(before, after, Frame(0, True, {"x": x}))

    assert check.passed == passed
    if passed:
        assert check.unsteady == ("y",)
        assert "; 1 more move as far by rounding alone" in check.remarks[0]


@pytest.mark.parametrize("guilty", [0, 1])
def test_the_largest_error_of_all_frames_counts(guilty: int) -> None:
    before, after, frame = graphs("Round", SHIFT)
    _give(after, w=np.full((1, 64), 1.3, np.float32))
    zeros = Frame(0, True, {"x": np.full((1, 64), -1.0, np.float32)})
    # where the sum is 0 in both, nothing differs by more than rounding
    frames = [frame, zeros] if guilty == 0 else [zeros, frame]

    assert not verified(before, after, *frames).passed


BRANCHES = """<ir_version: 9, opset_import: ["" : 19, "local" : 1]>
m (float[1,64] x, bool c) => (float[1,64] y) {
    b = Relu(x)
    a = CALL
    y = Round(a)
}
<domain: "local", opset_import: ["" : 19]> f (x) => (y) { y = Neg(x) }"""
IF = """If(c) <then_branch = t () => (float[1,64] p) { p = Neg(x) },
    else_branch = e () => (float[1,64] p) { p = Abs(x) }>"""


@pytest.mark.parametrize(
    ("was", "now"),
    [
        ("Neg(x)", "Abs(x)"),
        ("Neg(x)", "Neg(b)"),
        ("Elu<alpha = 0.5>(x)", "Elu<alpha = 0.25>(x)"),
        ("local.f(x)", "local.f(x)"),  # bodies are not looked into
        (IF, IF),
    ],
)
def test_what_may_compute_something_else_counts_as_changed(was: str, now: str) -> None:
    before, after = (read(BRANCHES.replace("CALL", text)) for text in (was, now))
    assert [step.outputs for step in steps_after_changes(before, after)] == [("y",)]


def test_what_changes_behind_a_step_is_found() -> None:
    before, after, frame = graphs("QuantizeLinear", SHIFT)
    frame.arrays["x"][0, 4::4] = -0.5
    node = after.graph.node("/head/Tanh")
    node.op_type = "Sigmoid"
    check = verified(before, after, frame)
    assert not check.passed
    assert check.unsteady == ()


def test_another_quantizer_is_no_piece() -> None:
    before, after, _ = graphs("QuantizeLinear", SHIFT)
    assert steps_after_changes(before, before.clone()) == ()
    assert [s.outputs for s in steps_after_changes(before, after)] == [("q",)]
    _give(after, one=np.array(1.5, np.float32))
    assert steps_after_changes(before, after) == ()


ACCUMULATES = """<ir_version: 9, opset_import: ["" : 19]>
m (float[1,64] x, float[1,64] memory)
    => (float[1,64] y, float[1,64] memory_out, int8[1,64] q)
<float one = {1.0}, int8 z = {0}> {
    ["/backbone/Add"] a = Add(x, w)
    ["/backbone/Q"] q = QuantizeLinear(a, one, z)
    ["/backbone/DQ"] s = DequantizeLinear(q, one, z)
    ["/head/Add"] memory_out = Add(memory, s)
    ["/head/Sum"] t = Add(memory_out, a)
    ["/head/Round"] y = Round(t)
}"""


def test_state_and_the_answers_that_are_outputs_are_those_of_the_first_graph() -> None:
    before = read(ACCUMULATES, w=np.ones((1, 64), np.float32))
    before.metadata_props["me2e.recurrent"] = '{"memory": "memory_out"}'
    infer_shapes(before)
    after = before.clone()
    _give(after, w=np.full((1, 64), 1 + SHIFT, np.float32))
    draws = np.random.default_rng(1)
    x = draws.uniform(-90, 90, (3, 1, 64)).astype(np.float32)
    x[:, 0, ::4] = -0.5 - SHIFT / 2
    frames = [Frame(i, i == 0, {"x": array}) for i, array in enumerate(x)]

    check = verified(before, after, *frames)

    assert check.unproven is None
    assert check.errors == {"y": 0.0, "memory_out": 0.0, "q": 0.0}
    assert "piece by piece" in check.remarks[0]


@pytest.mark.parametrize("target", ["onnxruntime", "tensorrt"])
def test_a_transformer_is_fused_behind_int8(target: str, tmp_path: Path) -> None:
    draws = np.random.default_rng(0)
    frames = draws.normal(size=(4, 1, 64, 64)).astype(np.float32)
    recording = CalibrationSet(record(tmp_path / "f", [{"x": each} for each in frames]))
    passes = tuple(
        dataclasses.replace(current, target=target)
        if isinstance(current, QuantizeInt8)
        else current
        for current in recipe.load("full-fused")
    )

    report = PassManager(passes).run(transformer(), Context(EVERYTHING, recording))

    assert not report.unproven
    kinds = {node.op_type for node in report.model.graph}
    assert {"MultiHeadAttention", "QuantizeLinear"} <= kinds
    (check,) = [c for c in report.verifications if "fuse-kernels" in c.passes]
    assert check.errors["the body of MultiHeadAttention"] < 1e-5


def _turned(function: ir.Function) -> ir.Function:
    """Return a body that negates its answer."""
    answer = function.outputs[0]
    node = ir.node("Neg", [answer])
    node.outputs[0].name = "turned"
    function.append(node)
    function.outputs[0] = node.outputs[0]
    return function


def _gone(function: ir.Function) -> ir.Function:
    """Return a body that no runtime can run."""
    node = next(node for node in function if node.op_type == "Reshape")
    shape = ir.node("Constant", [], {"value": ir.tensor(np.array([7, 997]))})
    shape.outputs[0].name = "odd"
    function.insert_before(node, shape)
    node.replace_input_with(1, shape.outputs[0])
    return function


PLUGIN = (
    ALIKE.replace("me2e.Multi", "mmdeploy.MMCVMulti")
    .replace("Attention(", "Attention<im2col_step = 32>(")
    .replace("float[1,5,2,4] y", "float[1,5,8] y")
    .replace("int64", "int32")
)


@pytest.mark.parametrize("text", [ALIKE, PLUGIN], ids=["own", "plugin"])
@pytest.mark.parametrize("spoil", [_turned, _gone])
def test_a_body_that_is_not_its_kernel_is_found(
    spoil: Callable[[ir.Function], ir.Function],
    text: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    right = AttachBodies._body
    monkeypatch.setattr(AttachBodies, "_body", lambda me, it: spoil(right(me, it)))
    # a session runs a plugin's body, where the file has one
    place = "the body of MultiScaleDeformableAttention" if text is ALIKE else "y"
    words = f"^attach-bodies promises the same outputs and changed {place} by"
    with pytest.raises(VerificationError, match=words):
        PassManager((AttachBodies(),)).run(read(text), Context(EVERYTHING))


@pytest.mark.parametrize("text", [ALIKE, PLUGIN], ids=["own", "plugin"])
def test_a_body_is_held_against_its_kernel(text: str) -> None:
    report = PassManager((AttachBodies(),)).run(read(text), Context(EVERYTHING))
    (check,) = report.verifications
    (error,) = [e for name, e in check.errors.items() if name.startswith("the body")]
    assert 0 < error < 1e-5
