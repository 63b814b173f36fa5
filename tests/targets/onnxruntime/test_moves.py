"""What keeps a grid, what has its own, and what is never negative: by numbers."""

import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.targets.onnxruntime.region import (
    MOVES,
    has_average_kernel,
    is_average,
    is_move,
    never_negative,
)
from tests.support.calls import calls
from tests.support.profiles import scaled
from tests.targets.onnxruntime.draws import (
    AVERAGED,
    MOVED,
    SHAPE,
    answer,
    of_node,
    on_grid,
    one_node,
    paired,
)
from tests.targets.onnxruntime.lowered import Floats

SEEDS = st.integers(0, 2**32 - 1)


def drawn(op: str, seed: int) -> tuple[ir.Model, Floats]:
    rng = np.random.default_rng(seed)
    shape = (2, 4, 1, 8) if op == "Squeeze" else SHAPE
    x = (rng.standard_normal(shape) * rng.uniform(0.1, 9)).astype(np.float32)
    return one_node(op, rng, shape), x


def test_every_operator_that_moves_is_drawn() -> None:
    assert set(MOVED) == MOVES


@pytest.mark.parametrize("op", sorted({*MOVES, *MOVED, *AVERAGED}))
@settings(max_examples=scaled(40))
@given(SEEDS, st.sampled_from([0, 128]))
def test_what_moves_gives_the_same_integers_before_and_behind(
    op: str, seed: int, zero: int
) -> None:
    model, x = drawn(op, seed)
    if not is_move(model.graph[0]):
        return
    grid = float(np.abs(x).max()) / (255 - zero), zero

    moved = answer(model, x)
    want = on_grid(moved, *grid)

    # on the input's grid, in onnxruntime's uint8, and in a range that holds all of it
    np.testing.assert_array_equal(answer(model, on_grid(x, *grid)), want)
    np.testing.assert_array_equal(
        answer(paired(model, grid, grid), x, optimize=True), want
    )
    assert np.abs(moved).max(initial=0) <= np.abs(x).max()


@given(st.sampled_from(sorted(AVERAGED)), SEEDS, st.sampled_from([0, 128]))
def test_int8_averages_are_those_of_the_nodes(op: str, seed: int, zero: int) -> None:
    model, x = drawn(op, seed)
    if not has_average_kernel(model.graph[0]):
        return
    x = np.abs(x) if zero == 0 else x
    mean = answer(model, x)
    before = float(np.abs(x).max()) / (255 - zero), zero
    behind = float(np.abs(mean).max()) / (255 - zero), zero

    qdq = paired(model, before, behind)

    # half a step is rounded either way
    difference = answer(qdq, x) - answer(qdq, x, optimize=True)
    assert np.abs(difference).max() < 1.5 * behind[0]


@pytest.mark.parametrize("op", sorted(AVERAGED))
def test_only_standard_averages_are_averages(op: str) -> None:
    value = ir.Value(name="x")
    own, other = ir.node(op, [value]), ir.node(op, [value], domain="vendor")

    assert is_average(own)
    assert has_average_kernel(own)
    assert not is_average(other)
    assert not has_average_kernel(other)


UNARY = (
    *("Abs", "Acos", "Asin", "Asinh", "Atan", "Celu", "Ceil", "Cos", "Elu", "Erf"),
    *("Exp", "Floor", "HardSigmoid", "HardSwish", "Identity", "LeakyRelu", "Log"),
    *("LogSoftmax", "Mish", "Neg", "PRelu", "Relu", "Round", "Selu", "Sigmoid", "Sign"),
    *("Sin", "Softmax", "Softplus", "Softsign", "Sqrt", "Tan", "Tanh"),
    *("ThresholdedRelu", "Hardmax", "GlobalMaxPool", "Reciprocal"),
)


@pytest.mark.parametrize("op", UNARY)
@settings(max_examples=scaled(20))
@given(SEEDS)
def test_what_counts_as_never_negative_is_not(op: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = (rng.standard_normal(SHAPE) * rng.uniform(0.1, 9)).astype(np.float32)
    alpha = float(rng.uniform(-1, 1))
    slopes = [np.full(8, alpha, np.float32)] if op == "PRelu" else []
    names = ("alpha", "beta") if op == "HardSigmoid" else ()
    model = of_node(op, dict.fromkeys(names, alpha), slopes)

    if never_negative(model.graph[0].outputs[0]):
        assert not (answer(model, x) < 0).any()


@pytest.mark.parametrize("op", sorted({*MOVED, *AVERAGED}))
@settings(max_examples=scaled(40))
@given(SEEDS)
def test_what_hands_on_that_nothing_is_negative_does(op: str, seed: int) -> None:
    model, x = drawn(op, seed)
    relu = ir.node("Relu", [ir.Value(name="r")])
    answers = answer(model, np.maximum(x, 0))
    node = model.graph[0]
    node.replace_input_with(0, relu.outputs[0])

    if never_negative(node.outputs[0]):
        assert not (answers < 0).any()
    else:  # it interpolates, or brings a value of its own
        assert op == "Resize"


def test_an_operator_of_another_domain_may_be_negative() -> None:
    value = ir.Value(name="x")

    for op in ("Abs", "Relu", "Softmax"):
        assert never_negative(ir.node(op, [value]).outputs[0])
        assert not never_negative(ir.node(op, [value], domain="vendor").outputs[0])
    own = ir.node("Relu", [value]).outputs
    assert never_negative(ir.node("Concat", own, {"axis": 1}).outputs[0])
    other = ir.node("Concat", own, {"axis": 1}, domain="vendor")
    assert not never_negative(other.outputs[0])


def nested(first: str, depth: int) -> ir.Value:
    """Concat a tensor with its own maximum, over and over."""
    source = ir.Value(name="x")
    value = ir.node(first, [source]).outputs[0]
    for _ in range(depth):
        pooled = ir.node("MaxPool", [value], {"kernel_shape": [1, 1]}).outputs[0]
        value = ir.node("Concat", [value, pooled], {"axis": 1}).outputs[0]
    return value


@pytest.mark.parametrize(("first", "found"), [("Relu", True), ("Neg", False)])
def test_what_many_ways_lead_to_is_looked_at_once(first: str, found: bool) -> None:
    value = nested(first, 2000)

    # one look at each way would be 2 ** 2000 calls
    assert calls(lambda: never_negative(value)) < 100 * 2000
    assert never_negative(value) is found


def test_one_negative_branch_is_enough() -> None:
    source = ir.Value(name="x")
    branches = [ir.node(op, [source]).outputs[0] for op in ("Relu", "Neg", "Sigmoid")]

    assert not never_negative(ir.node("Concat", branches, {"axis": 1}).outputs[0])
