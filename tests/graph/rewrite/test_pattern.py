import dataclasses
from typing import Any

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.base.errors import GraphError
from me2e_compress.graph.rewrite import (
    Fusion,
    Match,
    Pattern,
    constant,
    either,
    fuse,
    match,
    op,
    var,
)
from tests.passes.small import ops, read

X, Y = var("x"), var("y")


def graph_of(*lines: str, outputs: str = "y", **weights: Any) -> ir.Model:
    ports = ", ".join(f"float[2,3] {name}" for name in outputs.split())
    text = '<ir_version: 9, opset_import: ["" : 17, "own" : 1]>\n'
    text += f"g (float[2,3] x, float[2,3] z) => ({ports}) {{ {' '.join(lines)} }}"
    return read(text, **weights)


def last(pattern: Pattern, *lines: str, **weights: Any) -> Match | None:
    """Match the expression that ends in the last node."""
    return match(pattern, graph_of(*lines, **weights).graph[-1])


@pytest.mark.parametrize(
    ("op_type", "line", "matches"),
    [
        ("Mul", "y = Mul(x, a)", True),
        ("Mul", "y = Mul(a, x)", True),  # commutative
        ("Mul", "y = Mul(z, a)", False),  # one variable is one value
        ("Sub", "y = Sub(x, a)", True),
        ("Sub", "y = Sub(a, x)", False),
    ],
)
def test_operands(op_type: str, line: str, matches: bool) -> None:
    result = last(op(op_type, X, op("Sigmoid", X)), "a = Sigmoid(x)", line)
    assert (result is not None) == matches
    assert result is None or result[X].name == "x"


def test_one_operator_object_is_one_node() -> None:
    inner = op("Neg", X)
    square = op("Mul", inner, inner)
    assert last(square, "a = Neg(x)", "y = Mul(a, a)") is not None
    assert last(square, "a = Neg(x)", "b = Neg(x)", "y = Mul(a, b)") is None


def test_a_wrong_first_choice_is_taken_back() -> None:
    # the first Neg fits the first operand; only the other order fits both
    pattern = op("Add", op("Neg", X), op("Neg", op("Relu", Y)))
    lines = ("r = Relu(z)", "a = Neg(r)", "b = Neg(x)", "y = Add(a, b)")
    result = last(pattern, *lines)
    assert result is not None
    assert (result[X].name, result[Y].name) == ("x", "z")


TWICE = op("Relu", op("Relu", X))


def test_what_others_read_is_not_inner() -> None:
    read_too = graph_of("a = Relu(x)", "y = Relu(a)", "b = Neg(a)", outputs="y b")
    given = graph_of("a = Relu(x)", "y = Relu(a)", outputs="y a")
    for model in (read_too, given):
        assert match(TWICE, model.graph[1]) is None


@pytest.mark.parametrize(
    ("pattern", "value", "matches"),
    [
        (constant(), [[1.0, 2.0, 3.0]], True),
        (constant(scalar=True), [[1.0, 2.0, 3.0]], False),
        (constant(scalar=True), 0.5, True),
    ],
)
def test_constants(pattern: Pattern, value: Any, matches: bool) -> None:
    weights = {"c": np.array(value, np.float32)}
    result = last(op("Mul", X, pattern), "y = Mul(c, x)", **weights)
    assert (result is not None) == matches


def test_a_variable_can_ask_for_what_is_computed() -> None:
    computed = op("Add", var("v", computed=True), constant())
    weights = dict.fromkeys("pq", np.ones(1, np.float32))
    assert last(computed, "y = Add(p, q)", **weights) is None
    assert last(computed, "y = Add(p, x)", **weights) is not None


def test_alternatives_are_tried_in_order_and_told_apart() -> None:
    cast = op("Cast", X)
    pattern = op("Relu", either(cast, X))
    with_cast = last(pattern, "a = Cast<to = 1>(x)", "y = Relu(a)")
    without = last(pattern, "y = Relu(x)")
    assert with_cast is not None
    assert without is not None
    assert (cast in with_cast, cast in without) == (True, False)
    assert with_cast[X].name == without[X].name == "x"


CLIP = {"low": np.float32(0)}


@pytest.mark.parametrize(
    ("pattern", "line", "matches"),
    [
        (op("Clip", X), "y = Clip(x, low)", False),
        (op("Clip", X, more=True), "y = Clip(x, low)", True),
        (op("Relu", X), "y = own.Relu(x)", False),
    ],
)
def test_more_operands_and_domains(pattern: Pattern, line: str, matches: bool) -> None:
    weights = CLIP if "low" in line else {}
    assert (last(pattern, line, **weights) is not None) == matches


def test_a_node_whose_other_outputs_are_read_ends_nothing() -> None:
    model = graph_of("a, b = Split(x)", "y = Add(a, b)")
    assert match(op("Split", X), model.graph[0]) is None


def test_a_pattern_ends_in_an_operator() -> None:
    nothing = Fusion("nothing", either(op("Relu", X), X), lambda result, kit: None)
    with pytest.raises(GraphError, match="a fusion ends in an operator, not in Varia"):
        fuse(graph_of("y = Relu(x)"), [nothing], by="test")


ONCE = Fusion("Relu of Relu", TWICE, lambda m, kit: kit.replace_by("Relu", [m[X]]))


def test_what_a_rewrite_refuses_is_counted_with_its_reason() -> None:
    refused = dataclasses.replace(ONCE, rewrite=lambda match, kit: "no Relu today")
    model = graph_of("a = Relu(x)", "y = Relu(a)")

    result = fuse(model, [refused], by="test")

    assert ops(model) == ["Relu", "Relu"]
    assert result.notes() == ("left 1: no Relu today",)


def test_a_fusion_may_complete_another() -> None:
    model = graph_of("a = Relu(x)", "b = Relu(a)", "c = Relu(b)", "y = Relu(c)")
    silent = dataclasses.replace(ONCE, where=lambda m, facts: m[X].name == "none")
    assert fuse(model, [silent], by="test").notes() == ()
    assert fuse(model, [ONCE], by="test").notes() == ("fused: Relu of Relu (3)",)
    assert ops(model) == ["Relu"]


def test_a_fused_operator_takes_the_place_and_its_domain_is_imported() -> None:
    model = graph_of("a = HardSigmoid(x)", "y = Mul(x, a)")
    gate = op("Mul", X, op("HardSigmoid", X))
    one = Fusion("gate", gate, lambda m, k: k.replace_by("Gate", [m[X]], domain="mine"))
    assert fuse(model, [one], by="test").changes == 1
    (node,) = model.graph
    assert (node.domain, node.op_type) == ("mine", "Gate")
    assert model.graph.opset_imports["mine"] == 1
