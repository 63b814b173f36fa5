"""What follows where a value got longer along one axis."""

from typing import Literal

import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.errors import PreconditionError
from me2e_compress.passes.edges import carry
from tests.passes.hoisted import integers
from tests.passes.small import read

HEAD = '<ir_version: 9, opset_import: ["" : 17, "own" : 1]>\n'


def grown(
    shape: tuple[int, ...],
    axis: int,
    body: str,
    made: tuple[int, ...] = (1,),
    gives: str = "float y",
    b: ir.Shape | Literal["inferred"] | None = "inferred",
) -> ir.Model:
    """Let the readers of ``old`` in a body read two more along an axis instead.

    The body makes ``y`` of ``old``; ``made`` is a constant that it may read, and ``b``
    the shape that the file gives the value of that name.
    """
    more = [*shape]
    more[axis] = 2
    model = read(
        f"{HEAD}g (float{list(shape)} x, float{more} z) => ({gives}) {{\n"
        f"  old = Neg(x)  new = Concat<axis = {axis}>(old, z)  {body}\n}}",
        made=integers(*made),
    )
    graph.infer_shapes(model)
    old, new = model.graph[0].outputs[0], model.graph[1].outputs[0]
    for node in model.graph:
        if node.outputs[0].name == "b" and b != "inferred":
            node.outputs[0].shape = b
    for node, index in tuple(old.uses()):
        if node is not model.graph[1]:
            node.replace_input_with(index, new)
    carry(model, new, old, "more queries")
    return model


def shape_of(model: ir.Model, name: str) -> tuple[int, ...] | None:
    return next(
        graph.static_shape(value)
        for node in model.graph
        for value in node.outputs
        if value.name == name
    )


SUM = "y = ReduceSum<keepdims = 0>(b)"


def test_shapes_follow_up_to_where_the_axis_is_gone() -> None:
    model = grown(
        (1, 6, 8), 1, f"a = Relu(old)  b = Transpose<perm = [1, 0, 2]>(a) {SUM}"
    )

    assert (shape_of(model, "a"), shape_of(model, "b")) == ((1, 8, 8), (8, 1, 8))
    assert shape_of(model, "y") == ()


@pytest.mark.parametrize(
    ("shape", "axis", "made", "longer"),
    [
        ((1, 6, 8), 1, (1, 6, 2, 4), (1, 8, 2, 4)),
        ((1, 6, 8), 1, (6, 8), (8, 8)),
        ((4, 1, 4), 2, (4, 4, 1), (4, 6, 1)),  # the second of two that are as long
        ((4, 4, 1), 0, (4, 1, 4), (6, 1, 4)),  # the first
        ((2, 3, 6), 2, (6, 6), (6, 8)),
        ((6, 2, 3), 0, (6, 6), (8, 6)),
    ],
)
def test_a_reshape_gets_longer_where_the_axis_stands_in_its_result(
    shape: tuple[int, ...], axis: int, made: tuple[int, ...], longer: tuple[int, ...]
) -> None:
    model = grown(shape, axis, f"b = Reshape(old, made) {SUM}", made)

    assert shape_of(model, "b") == longer


@pytest.mark.parametrize(
    ("shape", "axis", "made"),
    [((1, 6, 8), 1, (1, 48)), ((1, 6, 8), 1, (3, 2, 8)), ((2, 6, 4), 1, (6, 8))],
)
def test_a_reshape_that_splits_or_merges_the_axis_is_refused(
    shape: tuple[int, ...], axis: int, made: tuple[int, ...]
) -> None:
    with pytest.raises(PreconditionError, match="the queries are no axis of that"):
        grown(shape, axis, f"b = Reshape(old, made) {SUM}", made)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("b = own.Plugin(old)", "does not fit n2 "),
        ("b = Add(old, x)", r"does not fit n2 \(Add\)"),
    ],
    ids=["a plugin", "a sum with what did not grow"],
)
def test_what_cannot_read_more_is_named(body: str, message: str) -> None:
    with pytest.raises(PreconditionError, match=f"more queries {message}"):
        grown((1, 6, 8), 1, f"{body}  {SUM}")


def test_an_output_of_the_graph_stays_as_it_is() -> None:
    with pytest.raises(
        PreconditionError, match=r"more queries would change y \[1,6,8\]"
    ):
        grown((1, 6, 8), 1, "y = Relu(old)", gives="float[1,6,8] y")


@pytest.mark.parametrize(
    ("body", "before"),
    [("b = NonZero(old)", ir.Shape([3, 48])), ("b = Relu(old)", None)],
    ids=["after", "before"],
)
def test_a_size_that_is_not_known_before_and_after_is_refused(
    body: str, before: ir.Shape | None
) -> None:
    with pytest.raises(PreconditionError, match="more queries would change b "):
        grown((1, 6, 8), 1, f"{body}  c = Cast<to = 1>(b)  y = ReduceSum(c)", b=before)
