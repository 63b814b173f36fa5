"""What ``fuse-basic`` writes otherwise for the sake of onnxruntime's CPU alone."""

from typing import Any

import numpy as np
import pytest

from me2e_compress.graph import rank_of, static_shape
from me2e_compress.passes.fuse_basic import FuseBasic
from tests.passes.small import apply, compute, ops, read

RANDOM = np.random.default_rng(8)


def text_of(body: str, *, x: str = "float[2,600,1]", y: str = "float[M,N,O]") -> str:
    return (
        f'<ir_version: 9, opset_import: ["" : 17]>\ng ({x} x) => ({y} y) {{ {body} }}'
    )


def constant_rank(text: str, **weights: Any) -> int | None:
    """Apply the pass; return the rank that the constant ``c`` of a node has then."""
    model, before = read(text, **weights), read(text, **weights)
    shape = static_shape(before.graph.inputs[0]) or ()
    x = RANDOM.normal(size=shape).astype(np.float32)
    apply(FuseBasic(), model)
    (want,), (got,) = compute(before, {"x": x}), compute(model, {"x": x})
    np.testing.assert_array_equal(got, want)
    node = next(node for node in model.graph if len(node.inputs) == 2)
    (rank,) = (rank_of(v) for v in node.inputs if v is not None and v.name != "x")
    return rank


@pytest.mark.parametrize(
    ("shape", "call", "constant", "rank"),
    [
        ("2,600,1", "Sub(x, c)", np.float32(0.5), 3),
        ("2,600,1", "Sub(c, x)", np.ones(1, np.float32), 3),
        ("1200,1,1", "Max(x, c)", np.ones((1, 1), np.float32), 3),
        ("2,600,1", "Sub(x, c)", np.ones((1, 1), np.float32), 2),
        ("2,600", "Sub(x, c)", np.float32(0.5), 0),
        ("2,300,1", "Sub(x, c)", np.float32(0.5), 0),
    ],
)  # fmt: skip
def test_a_constant_gets_axes_where_the_last_are_one(
    shape: str, call: str, constant: Any, rank: int
) -> None:
    """Joined axes, of more than one element or as many as 1,000, are fast already."""
    text = text_of(f"y = {call}", x=f"float[{shape}]", y="float[" + shape + "]")
    assert constant_rank(text, c=constant) == rank


def test_another_reader_keeps_its_constant() -> None:
    body = "a = Sub(x, c) b = Reshape(a, flat) y = Mod<fmod = 1>(b, c)"
    weights = {"c": np.float32(0.5), "flat": np.array([-1])}
    model = read(text_of(body, y="float[1200]"), **weights)
    apply(FuseBasic(), model)
    assert rank_of(model.graph.node(2).inputs[1]) == 0


COUNT = (
    "e = Equal(x, zero) n = Not(e) i = Cast<to = 7>(n) s = ReduceSum{}(i{})"
    " y = Greater(s, nothing)"
)


@pytest.mark.parametrize(
    ("options", "axes", "y"),
    [
        ("<keepdims = 0>", "", "bool"),
        ("", ", last", "bool[2,3,1]"),
        ("<noop_with_empty_axes = 1>", "", "bool[2,3,4]"),
    ],
)
def test_conditions_are_not_counted_as_integers(
    options: str, axes: str, y: str
) -> None:
    text = text_of(COUNT.format(options, axes), x="float[2,3,4]", y=y)
    weights = {"zero": np.float32(0), "nothing": np.int64(0), "last": np.array([-1])}
    model, before = read(text, **weights), read(text, **weights)
    result = apply(FuseBasic(), model)
    assert "fused: sums of conditions (1)" in result.notes
    assert "INT64" not in {str(v.dtype) for node in model.graph for v in node.outputs}
    x = np.zeros((2, 3, 4), np.float32)
    for filled in (x, x + (np.arange(3) == 1)[:, None], x + np.float32("nan")):
        feeds = {"x": filled.astype(np.float32)}
        (want,), (got,) = compute(before, feeds), compute(model, feeds)
        np.testing.assert_array_equal(got, want)


@pytest.mark.parametrize(
    ("body", "kind"),
    [
        (COUNT.format("<keepdims = 0>", "").replace("nothing", "one"), "a number"),
        (COUNT.format("<keepdims = 0>", "").replace("(n)", "(x)"), "no conditions"),
    ],
)
def test_other_sums_stay(body: str, kind: str) -> None:
    weights = {"zero": np.float32(0), "nothing": np.int64(0), "one": np.int64(1)}
    model = read(text_of(body, x="float[2,3,4]", y="bool"), **weights)
    apply(FuseBasic(), model)
    assert ops(model)[-3:] == ["Cast", "ReduceSum", "Greater"]
    assert model.graph.node(-3).attributes["to"].as_int() == 7, kind
