from typing import Any

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.errors import GraphError
from me2e_compress.graph.rewrite import (
    Facts,
    Fusion,
    Match,
    Pattern,
    constant,
    either,
    fuse,
    match,
    op,
    product,
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


@pytest.mark.parametrize("line", ["y = Mul(x, a)", "y = Mul(a, x)"])
def test_commutative_operands_match_in_either_order(line: str) -> None:
    found = last(op("Mul", X, op("Sigmoid", X)), "a = Sigmoid(x)", line)
    assert found is not None
    assert found[X].name == "x"


@pytest.mark.parametrize(
    ("line", "matches"), [("y = Sub(z, a)", 1), ("y = Sub(a, z)", 0)]
)
def test_other_operands_have_their_place(line: str, matches: int) -> None:
    found = last(op("Sub", X, op("Sigmoid", Y)), "a = Sigmoid(x)", line)
    assert (found is not None) == matches


def test_one_variable_is_one_value() -> None:
    assert (
        last(op("Mul", X, op("Sigmoid", X)), "a = Sigmoid(x)", "y = Mul(z, a)") is None
    )


def test_one_operator_object_is_one_node() -> None:
    inner = op("Neg", X)
    square = op("Mul", inner, inner)
    assert last(square, "a = Neg(x)", "y = Mul(a, a)") is not None
    assert last(square, "a = Neg(x)", "b = Neg(x)", "y = Mul(a, b)") is None


def test_a_wrong_first_choice_is_taken_back() -> None:
    # the first Neg fits the first operand; only the other order fits both
    pattern = op("Add", op("Neg", X), op("Neg", op("Relu", Y)))
    lines = ("r = Relu(z)", "a = Neg(r)", "b = Neg(x)", "y = Add(a, b)")
    found = last(pattern, *lines)
    assert found is not None
    assert (found[X].name, found[Y].name) == ("x", "z")


TWICE = op("Relu", op("Relu", X))


def test_what_another_node_reads_is_not_inner() -> None:
    model = graph_of("a = Relu(x)", "y = Relu(a)", "b = Neg(a)", outputs="y b")
    assert match(TWICE, model.graph[1]) is None


def test_an_output_is_not_inner() -> None:
    model = graph_of("a = Relu(x)", "y = Relu(a)", outputs="y a")
    assert match(TWICE, model.graph[1]) is None


def test_what_is_shared_may_be_read_by_others() -> None:
    shared = op("Relu", op("Relu", X, shared=True))
    model = graph_of("a = Relu(x)", "y = Relu(a)", outputs="y a")
    assert match(shared, model.graph[1]) is not None


def test_what_a_body_reads_is_made_elsewhere() -> None:
    text = """
    <ir_version: 9, opset_import: ["" : 17]>
    g (float[2] x, bool seen) => (float[2] y) {
        a = Relu(x)
        y = If (seen) <then_branch = then () => (float[2] t) { t = Relu(a) },
                       else_branch = other () => (float[2] e) { e = Neg(x) }>
    }
    """
    model = read(text)
    inner = next(
        node for node in model.graph.all_nodes() if node.outputs[0].name == "t"
    )
    assert match(TWICE, inner) is None


@pytest.mark.parametrize(
    ("pattern", "value", "matches"),
    [
        (constant(), [[1.0, 2.0, 3.0]], True),
        (constant(scalar=True), [[1.0, 2.0, 3.0]], False),
        (constant(0.7071), 0.70712, True),
        (constant(0.7071), 0.708, False),
        (constant(0.0), 1e-9, False),
    ],
)
def test_constants(pattern: Pattern, value: Any, matches: bool) -> None:
    weights = {"c": np.array(value, np.float32)}
    found = last(op("Mul", X, pattern), "y = Mul(c, x)", **weights)
    assert (found is not None) == matches


def test_a_given_number_may_stand_in_several_places() -> None:
    one = constant(1.0)
    lines = ("a = Add(x, p)", "y = Div(q, a)")
    weights = dict.fromkeys("pq", np.ones(1, np.float32))
    assert last(op("Div", one, op("Add", X, one)), *lines, **weights) is not None


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


def test_operands_may_follow_where_the_pattern_says_so() -> None:
    lines = ("y = Clip(x, low)",)
    low = np.float32(0)
    assert last(op("Clip", X), *lines, low=low) is None
    assert last(op("Clip", X, more=True), *lines, low=low) is not None


def test_attributes_are_asked_of_the_node() -> None:
    over = op("Softmax", X, where=lambda node: node.attributes.get_int("axis", -1) == 1)
    assert last(over, "y = Softmax<axis = 1>(x)") is not None
    assert last(over, "y = Softmax<axis = 0>(x)") is None


def test_a_domain_of_ones_own() -> None:
    assert last(op("Relu", X), "y = own.Relu(x)") is None
    assert last(op("Relu", X, domain="own"), "y = own.Relu(x)") is not None


HALF, TWO = np.float32(0.5), np.float32(2)


@pytest.mark.parametrize(
    "lines",
    [
        ("a = Mul(x, z)", "y = Mul(a, half)"),
        ("a = Mul(half, z)", "y = Mul(a, x)"),
        ("a = Div(z, two)", "y = Mul(x, a)"),
        ("a = Mul(x, z)", "y = Div(a, two)"),
    ],
)
def test_a_product_in_any_order_and_grouping(lines: tuple[str, ...]) -> None:
    found = last(product(X, Y, scale=0.5), *lines, half=HALF, two=TWO)
    assert found is not None
    assert {found[X].name, found[Y].name} == {"x", "z"}


def test_powers_are_factors() -> None:
    three = np.float32(3)
    cube = product(X, X, X, scale=0.5)
    found = last(cube, "a = Pow(x, three)", "y = Mul(a, half)", half=HALF, three=three)
    assert found is not None


def test_a_product_that_others_read_is_one_factor() -> None:
    model = graph_of("a = Mul(x, z)", "y = Mul(a, half)", outputs="y a", half=HALF)
    assert match(product(X, Y, scale=0.5), model.graph[1]) is None
    assert match(product(X, scale=0.5), model.graph[1]) is not None


def test_a_node_whose_other_outputs_are_read_ends_nothing() -> None:
    model = graph_of("a, b = Split(x)", "y = Add(a, b)")
    assert match(op("Split", X), model.graph[0]) is None


def test_a_pattern_ends_in_an_operator() -> None:
    nothing = Fusion("nothing", either(op("Relu", X), X), lambda found, kit: None)
    with pytest.raises(GraphError, match="a fusion ends in an operator, not in Varia"):
        fuse(graph_of("y = Relu(x)"), [nothing], by="test")


def test_relu_of_relu_in_four_lines() -> None:
    x = var("x")
    twice = op("Relu", op("Relu", x))
    once = Fusion("Relu of Relu", twice, lambda m, kit: kit.put("Relu", [m[x]]))
    model = graph_of("a = Relu(x)", "y = Relu(a)")

    found = fuse(model, [once], by="drop-relu-of-relu")

    assert ops(model) == ["Relu"]
    assert found.notes() == ("fused: Relu of Relu (1)",)


def test_what_a_check_refuses_is_counted_with_its_reason() -> None:
    def check(found: Match, facts: Facts) -> str | None:
        return f"no Relu at opset {facts.opset}"

    refused = Fusion("r", TWICE, lambda m, kit: kit.put("Relu", [m[X]]), check)
    model = graph_of("a = Relu(x)", "y = Relu(a)")

    found = fuse(model, [refused], by="test")

    assert ops(model) == ["Relu", "Relu"]
    assert found.notes() == ("left 1: no Relu at opset 17",)


def test_what_is_no_match_after_all_is_not_counted() -> None:
    silent = Fusion(
        "r",
        TWICE,
        lambda m, kit: kit.put("Relu", [m[X]]),
        where=lambda m, facts: m[X].name == "z",
    )
    found = fuse(graph_of("a = Relu(x)", "y = Relu(a)"), [silent], by="test")
    assert found.notes() == ()


def test_a_fusion_may_complete_another() -> None:
    once = Fusion("r", TWICE, lambda m, kit: kit.put("Relu", [m[X]]))
    model = graph_of("a = Relu(x)", "b = Relu(a)", "c = Relu(b)", "y = Relu(c)")
    assert fuse(model, [once], by="test").changes == 3
    assert ops(model) == ["Relu"]


def test_bodies_are_fused_too() -> None:
    text = """
    <ir_version: 9, opset_import: ["" : 17]>
    g (float[2] x, bool seen) => (float[2] y) {
        y = If (seen) <
            then_branch = then () => (float[2] t) { a = Relu(x) t = Relu(a) },
            else_branch = other () => (float[2] e) { e = Neg(x) }
        >
    }
    """
    once = Fusion("r", TWICE, lambda m, kit: kit.put("Relu", [m[X]]))
    model = read(text)
    assert fuse(model, [once], by="test").changes == 1
    assert sorted(node.op_type for node in model.graph.all_nodes()) == [
        "If",
        "Neg",
        "Relu",
    ]
