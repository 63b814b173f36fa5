"""Broadcast products become products of more rows; numpy says what they are."""

from typing import Any

import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.graph import static_shape
from me2e_compress.passes import flatten_matmul
from me2e_compress.passes.flatten_matmul import FlattenMatmul
from me2e_compress.passes.work import small_products
from tests.passes.hoisted import graph_of
from tests.passes.small import apply, compute, ops, read

RANDOM = np.random.default_rng(5)


def product(left: tuple[int, ...], right: tuple[int, ...], before: str = "") -> str:
    """Write MatMul(a, b), or what ``before`` makes of them, in float64."""
    out = (*np.broadcast_shapes(left[:-2], right[:-2]), left[-2], right[-1])
    a, b, y = (",".join(map(str, shape)) for shape in (left, right, out))
    names = ("p", "q") if before else ("a", "b")
    body = f"{before} y = MatMul({names[0]}, {names[1]})"
    return graph_of(f"(double[{a}] a, double[{b}] b) => (double[{y}] y)", body)


def feeds(*shapes: tuple[int, ...]) -> dict[str, Any]:
    pairs = zip("ab", shapes, strict=True)
    return {name: RANDOM.normal(size=shape) for name, shape in pairs}


def holds_product(model: ir.Model, *shapes: tuple[int, ...]) -> None:
    given_ = feeds(*shapes)
    (got,) = compute(model, given_)
    np.testing.assert_allclose(got, given_["a"] @ given_["b"], rtol=0, atol=1e-9)


def matmul_shapes(model: ir.Model) -> list[Any]:
    (node,) = (node for node in model.graph if node.op_type == "MatMul")
    return [static_shape(value) for value in node.inputs]


PAIRS = st.tuples(st.integers(1, 3), st.sampled_from(("both", "left", "right")))


@settings(max_examples=80)
@given(st.lists(PAIRS, max_size=4), st.tuples(*[st.integers(1, 3)] * 3), st.data())
def test_any_product_keeps_its_result(
    axes: list[tuple[int, str]], ends: tuple[int, int, int], data: st.DataObject
) -> None:
    rows, inner, columns = ends
    left = [size if who != "right" else 1 for size, who in axes]
    right = [size if who != "left" else 1 for size, who in axes]
    for shape in (left, right):  # leading axes of size 1 may be left out
        while shape and shape[0] == 1 and data.draw(st.booleans()):
            del shape[0]
    a, b = (*left, rows, inner), (*right, inner, columns)
    model = read(product(a, b))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flatten_matmul, "SMALL_PRODUCTS_PER_NODE", 1e-3)
        apply(FlattenMatmul(), model)

    holds_product(model, a, b)
    shapes = matmul_shapes(model)
    assert small_products(*shapes) <= small_products(a, b)


CAMERAS, HEIGHTS, CELLS = 6, 4, 1000
MATRICES = (CAMERAS, 1, 1, 4, 4)
POINTS = (1, HEIGHTS, CELLS, 4, 1)


@pytest.mark.parametrize(
    ("a", "b", "shapes"),
    [
        (MATRICES, POINTS, [(1, HEIGHTS * CELLS, 4), (CAMERAS, 4, 4)]),
        # agents that attend to the same lanes: all of them at once, for each head
        ((400, 8, 1, 32), (1, 8, 32, 20), [(8, 400, 32), (8, 32, 20)]),
    ],
)
def test_a_matrix_for_each_camera_times_all_points(
    a: tuple[int, ...], b: tuple[int, ...], shapes: list[tuple[int, ...]]
) -> None:
    model = read(product(a, b))
    assert apply(FlattenMatmul(), model).notes == ("flattened 1 product",)
    assert matmul_shapes(model) == shapes
    holds_product(model, a, b)


def test_repetitions_are_not_read_in_front_of_a_product() -> None:
    """As BEVFormer is exported: matrices and points, each repeated for the other."""
    a, b = (1, 1, CAMERAS, 1, 4, 4), (HEIGHTS, 1, 1, CELLS, 4)
    before = (
        "times = Constant<value_ints = [4, 1, 1, 1000, 1, 1]>() p = Tile(a, times)"
        " many = Constant<value_ints = [4, 1, 6, 1000, 4]>() e = Expand(b, many)"
        " last = Constant<value_ints = [-1]>() q = Unsqueeze(e, last)"
    )
    whole = (HEIGHTS, 1, CAMERAS, CELLS, 4)
    model = read(product((*whole, 4), (*whole, 1), before))
    for value, shape in zip(model.graph.inputs, (a, b), strict=True):
        value.shape = ir.Shape(shape)

    result = apply(FlattenMatmul(), model)

    assert "2 repeated operands read unrepeated" in result.notes
    assert {"Tile", "Expand"}.isdisjoint(ops(model))
    assert matmul_shapes(model) == [(HEIGHTS, 1, CELLS, 4), (1, CAMERAS, 4, 4)]
    given_ = feeds(a, b)
    (got,) = compute(model, given_)
    want = given_["a"] @ given_["b"][..., None]
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("small", "times", "whole", "other"),
    [
        ((2, 3, 1), "1, 1, 5", (2, 3, 5), (2, 5, 4)),  # of the matrix itself
        ((1, 3, 5), "4, 1, 1", (4, 3, 5), (5, 4)),  # the product has no such batch
        ((2, 3, 5), "2, 1, 1", (4, 3, 5), (4, 5, 4)),  # of more than one
    ],
)
def test_repetitions_that_a_product_does_not_do_stay(
    small: tuple[int, ...], times: str, whole: tuple[int, ...], other: tuple[int, ...]
) -> None:
    before = f"times = Constant<value_ints = [{times}]>() p = Tile(a, times)"
    model = read(product(whole, other, f"{before} q = Relu(b)"))
    model.graph.inputs[0].shape = ir.Shape(small)
    assert apply(FlattenMatmul(), model).changes == 0


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ((1, 10000, 256), (256, 512)),  # one batch of rows in every runtime
        ((1, 8, 300, 32), (1, 8, 32, 300)),  # attention: both have the batch
        ((2, 3, 5, 4), (2, 1, 4, 4)),  # too few products to pay for views
        ((5, 8, 300, 32), (1, 8, 32, 20)),  # rows would have to move behind heads
    ],
)
def test_what_is_left_alone(left: tuple[int, ...], right: tuple[int, ...]) -> None:
    result = apply(FlattenMatmul(), read(product(left, right)))
    assert (result.changes, result.notes) == (0, ())


def test_unknown_sizes_are_left_alone() -> None:
    text = graph_of(
        "(double[c,1,4,4] a, double[1,n,4,1] b) => (double[c,n,4,1] y)",
        "y = MatMul(a, b)",
    )
    result = apply(FlattenMatmul(), read(text))
    assert result.changes == 0


def test_a_wide_matrix_must_save_more_starts_than_it_moves_bytes() -> None:
    """It is transposed: 8 MB, read and written, are 400 node starts."""
    a = (1, 1000, 1000)
    assert apply(FlattenMatmul(), read(product(a, (9000, 1000, 1)))).changes == 0
    assert apply(FlattenMatmul(), read(product(a, (12000, 1000, 1)))).changes == 1
