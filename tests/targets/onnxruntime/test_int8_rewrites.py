"""Lint names what onnxruntime's int8 computes otherwise, and nothing else."""

import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from me2e_compress.graph import array_of
from me2e_compress.runtime.optimized import optimize
from me2e_compress.runtime.session import Session
from me2e_compress.targets.onnxruntime import OnnxRuntime
from me2e_compress.targets.onnxruntime.convert import int8_layers
from me2e_compress.targets.onnxruntime.lint_rules import int8_rewrites
from tests.support.nets import net, placed
from tests.support.profiles import scaled
from tests.targets.onnxruntime.rewritten import SIZE, STEP, Drawn

FAR_DB, ROUNDED_DB = 26.0, 60.0
"""SQNR of what is computed otherwise (but a rounded weight), and of a rounded one."""


def sqnr(drawn: Drawn, *, stock: bool = False) -> float:
    """Hold a session against the nodes as they stand, in float64."""
    model, frame = drawn.model(), drawn.frame()
    exact = Session(model, threads=1, optimize=False).run(frame)["y"]
    answer = Session(model, threads=1, stock=stock).run(frame)["y"]
    wide = np.asarray(exact, np.float64)
    noise = wide - np.asarray(answer, np.float64)
    return float(
        10 * np.log10(np.square(wide).sum() / (np.square(noise).sum() + 1e-30))
    )


@st.composite
def layers(draw: st.DrawFn) -> Drawn:
    """Draw a form; a MatMul has a bias, and no operator gives an int32 one."""
    op = draw(st.sampled_from(("Conv", "ConvTranspose", "Gemm", "Add")))
    weight = draw(st.sampled_from(("channel", "tensor", "float")))
    biases = ("float", "far", "own", "none") if weight == "float" else (
        "float", "far", "own", "right", "none",
    )  # fmt: skip
    bias = draw(st.sampled_from(biases))
    assume(op != "Add" or bias != "none")
    shapes = ((SIZE,),) if op.startswith("Conv") else ((SIZE,), (1, SIZE))
    rows = op == "Add" and draw(st.booleans())
    return Drawn(
        op,
        weight,
        bias,
        draw(st.sampled_from(shapes)) if bias != "right" else (SIZE,),
        draw(st.sampled_from(("", "Cast"))),
        draw(st.sampled_from(("", "Relu", "Transpose", "Sigmoid"))),
        answered=draw(st.booleans()),
        transposed=op == "Gemm" and draw(st.booleans()),
        rows=rows,
        kind=draw(st.sampled_from(("uint8", "int8"))),
        opset=draw(st.sampled_from((13, 17, 19, 21))),
        seed=draw(st.integers(0, 2**32 - 2)),
    )


@settings(max_examples=scaled(80))
@given(layers())
def test_what_runs_otherwise_is_named_and_nothing_else(drawn: Drawn) -> None:
    rules = [each.rule for each in int8_rewrites(drawn.model())]

    apart = sqnr(drawn, stock=True)

    if "float-weight" in rules:
        assert apart < ROUNDED_DB
    elif rules:
        assert apart < FAR_DB
    else:
        assert apart > FAR_DB  # ties are rounded otherwise at times


@settings(max_examples=scaled(50))
@given(layers())
def test_our_sessions_answer_what_the_nodes_say(drawn: Drawn) -> None:
    assert sqnr(drawn) > 100


@pytest.mark.parametrize(
    ("drawn", "rule", "words"),
    [
        (Drawn(bias="far"), "wrapped-bias", "1 of 8 do not fit"),
        (Drawn("ConvTranspose", bias="far"), "wrapped-bias", "of channel 3 is"),
        (Drawn("Add", bias="far", rows=True), "wrapped-bias", "1 of 8 do not fit"),
        (Drawn("Gemm", bias="own"), "bias-scale", "the file in steps of 0.001"),
        (Drawn("Add", "tensor", "own", (1, SIZE)), "bias-scale", "steps of 0.001"),
        (Drawn(weight="float"), "float-weight", "rounds its float weight to int8"),
    ],
)
def test_the_layer_and_the_cause_are_named(drawn: Drawn, rule: str, words: str) -> None:
    found = [e for e in OnnxRuntime().lint(drawn.model()) if e.severity == "wrong"]

    assert [(each.rule, each.node) for each in found] == [(rule, "layer")]
    assert words in found[0].message


@pytest.mark.parametrize(("off", "rules"), [(1.0005, []), (1.002, ["bias-scale"])])
def test_a_scale_that_float16_rounded_is_the_right_one(
    off: float, rules: list[str]
) -> None:
    model = Drawn("Gemm", bias="right").model()
    scale = model.graph.initializers["bs"]
    assert scale.const_value is not None
    scale.const_value = ir.tensor(scale.const_value.numpy() * np.float32(off))

    assert [each.rule for each in int8_rewrites(model)] == rules


@pytest.mark.parametrize(("share", "rules"), [(0.99, []), (1.01, ["wrapped-bias"])])
def test_a_bias_wraps_beyond_int32(share: float, rules: list[str]) -> None:
    model, frame = Drawn().model(), Drawn().frame()
    stored = model.graph.initializers
    scales, bias = (stored[name].const_value for name in ("ws", "b"))
    assert scales is not None
    assert bias is not None
    numbers = bias.numpy().copy()
    numbers[5] = share * 2.0**31 * STEP * scales.numpy()[5]
    stored["b"].const_value = ir.tensor(numbers)
    # the widest grid that still shows the channel
    stored["t"].const_value = ir.tensor(np.float32(numbers[5] / 100))

    answers = [
        Session(model, threads=1, stock=stock).run(frame)["y"][:, 5].mean()
        for stock in (False, True)
    ]

    assert [each.rule for each in int8_rewrites(model)] == rules
    assert (answers[1] < 0 < answers[0]) == bool(rules)


def test_what_lies_behind_rows_that_were_flattened() -> None:
    """A clip behind them keeps the layer float; so the bias does not wrap."""
    drawn = Drawn("Add", bias="far", rows=True, behind="Relu")

    assert not list(int8_rewrites(drawn.model()))
    assert sqnr(drawn, stock=True) > FAR_DB


UP = """
up (float[1,8,6,6] x, float[8,8,1,1] w, float[8,8,2,2] t, float[8] b, float[8,8,1,1] v)
    => (float[1,8,12,12] y) {
    c = Conv(x, w)
    r = Relu(c)
    u = ConvTranspose<kernel_shape=[2,2], strides=[2,2]>(r, t%s)
    s = Relu(u)
    y = Conv(s, v)
}
"""


@pytest.mark.parametrize("bias", ["", ", b"])
def test_a_layer_that_stays_float_keeps_its_weight(bias: str) -> None:
    random = np.random.default_rng(0)
    sizes = {"w": (8, 8, 1, 1), "t": (8, 8, 2, 2), "b": (8,), "v": (8, 8, 1, 1)}
    weights = {name: random.normal(0, 0.3, size) for name, size in sizes.items()}
    # one scale in all leaves little of the other channels
    weights["t"][:, 0] *= 300

    small = placed(net(UP % bias, weights), "onnxruntime")

    assert [each.op_type for each in int8_layers(small)] == ["Conv", "Conv"]
    assert not list(int8_rewrites(small))
    assert "Sum" in [node.op_type for node in small.graph]
    (up,) = (n for n in optimize(small).graph if n.op_type == "ConvTranspose")
    assert up.inputs[1] is not None
    assert array_of(up.inputs[1]) is not None  # not behind a DequantizeLinear


@pytest.mark.parametrize("op", ["Gemm", "Add"])
@pytest.mark.parametrize(
    ("without", "rules"),
    [("", ["bias-scale"]), ("weight", []), ("input", ["bias-scale"])],
)
def test_a_product_becomes_int8_where_the_zero_point_of_its_weight_is_written(
    op: str, without: str, rules: list[str]
) -> None:
    drawn = Drawn(op, bias="own", kind="int8", without_zero=without)

    assert [each.rule for each in int8_rewrites(drawn.model())] == rules
    assert (sqnr(drawn, stock=True) < FAR_DB) == bool(rules)
