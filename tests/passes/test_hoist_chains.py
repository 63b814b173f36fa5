"""Any chain before a product or behind a repetition: less work, the same numbers."""

import math
from typing import Any

import hypothesis
import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import strategies as st

from me2e_compress.graph import infer_shapes, static_shape
from me2e_compress.passes import work
from me2e_compress.passes.hoist_linear import HoistLinear, repeats, sums
from tests.passes.hoisted import difference, graph_of, integers, products
from tests.passes.small import NO_MODULES, RANDOM, compute, normal, read
from tests.profiles import scaled

MOVES = (
    "expand",
    "tile",
    "gather",
    "reshape",
    "transpose",
    "unsqueeze",
    "slice",
    "add",
    "layer",
    "peak",
)


@st.composite
def chains(draw: st.DrawFn) -> tuple[str, dict[str, Any]]:
    """A value that is rearranged, repeated and added to, and then multiplied."""
    width = draw(st.integers(1, 6))
    shape = [draw(st.integers(1, 3)), draw(st.integers(1, 4)), width]
    start = list(shape)
    weights: dict[str, Any] = {}
    steps: list[str] = []
    moves = draw(st.lists(st.sampled_from(MOVES), max_size=6))
    for index, move in enumerate(moves):
        name = f"c{index}"
        repeats = draw(st.integers(1, 9))
        if move == "expand":
            shape = [repeats, *shape]
            weights[name] = integers(*shape)
            call = f"Expand(v{index}, {name})"
        elif move == "tile":
            weights[name] = integers(repeats, *[1] * (len(shape) - 1))
            shape = [shape[0] * repeats, *shape[1:]]
            call = f"Tile(v{index}, {name})"
        elif move == "gather":
            weights[name] = RANDOM.integers(0, shape[0], repeats)
            shape = [repeats, *shape[1:]]
            call = f"Gather(v{index}, {name})"
        elif move == "reshape":
            shape = [math.prod(shape[:-1]), width]
            weights[name] = integers(*shape)
            call = f"Reshape(v{index}, {name})"
        elif move == "transpose":
            order = [*range(len(shape) - 2, -1, -1), len(shape) - 1]
            shape = [shape[axis] for axis in order]
            call = f"Transpose<perm = {order}>(v{index})"
        elif move == "unsqueeze":
            shape = [1, *shape]
            weights[name] = integers(0)
            call = f"Unsqueeze(v{index}, {name})"
        elif move == "slice":
            shape = [max(1, shape[0] - 1), *shape[1:]]
            weights |= {name: integers(shape[0]), "zero": integers(0)}
            call = f"Slice(v{index}, zero, {name}, zero)"
        elif move == "layer":
            wide = draw(st.integers(1, 6))
            weights |= {name: normal(width, wide), f"b{index}": normal(wide)}
            steps.append(f"m{index} = MatMul(v{index}, {name})")
            call, width = f"Add(b{index}, m{index})", wide
            shape = [*shape[:-1], width]
        elif move == "peak":
            peak = f"p{index} = ReduceMax<axes = [0], keepdims = 1>(v{index})"
            steps.append(peak)
            call = f"Add(p{index}, v{index})"
        else:
            weights[name] = normal(*draw(st.sampled_from([[width], [1, width], shape])))
            call = f"{draw(st.sampled_from(['Add', 'Sub']))}(v{index}, {name})"
        steps.append(f"v{index + 1} = {call}")
    weights["w"] = normal(width, draw(st.integers(1, 5)))
    body = f"v0 = Neg(x) {' '.join(steps)} y = MatMul(v{len(moves)}, w)"
    result = ",".join("ABCDEFGHIJK"[: len(shape)])
    text = graph_of(f"(float{start} x) => (float[{result}] y)", body)
    return text.replace("float[1 ", "float[1"), weights


def effort(model: ir.Model) -> tuple[int, int]:
    """Return the MACs of products, and how many numbers sums put out."""
    sums = [node.outputs[0] for node in model.graph if node.op_type in ("Add", "Sub")]
    return products(model), sum(math.prod(static_shape(each) or ()) for each in sums)


ONE_ROW_OF_TWO = (
    graph_of(
        "(float[1,1,1] x) => (float[A,B,C,D] y)",
        "v0 = Neg(x) v1 = Expand(v0, c0) v2 = Add(v1, c1) v3 = Gather(v2, c2)"
        " y = MatMul(v3, w)",
    ),
    {"w": normal(1, 1), "c0": integers(2, 1, 1, 1), "c1": normal(1), "c2": integers(0)},
)
"""The product is of one row already; the sum in front of it need not be of two."""


@hypothesis.given(chains())
@hypothesis.example(ONE_ROW_OF_TWO)
@hypothesis.settings(max_examples=scaled(60))
def test_any_chain_in_front_of_a_product(drawn: tuple[str, dict[str, Any]]) -> None:
    """Products this small never pay: here one costs what starting a node does."""
    text, weights = drawn
    model = read(text, **weights)
    infer_shapes(model)
    before = effort(model)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sums, "MACS_PER_NODE", 1)
        changes = HoistLinear(bytes_per_node=10**9).run(model, NO_MODULES).changes
    hypothesis.event(f"changes: {min(changes, 1)}")
    infer_shapes(model, strict=True)
    assert effort(model) < before if changes else effort(model) == before
    assert difference(model, text, weights) < 1e-5


STEPS = (
    *("expand", "tile", "merge", "split", "turn", "unary", "sum", "softmax"),
    *("reduce", "join", "stack"),
)


@st.composite
def repetitions(draw: st.DrawFn) -> tuple[str, dict[str, Any]]:
    """A value that is repeated, regrouped and computed with."""
    start = draw(st.lists(st.integers(1, 3), min_size=2, max_size=3))
    shape, steps, weights = list(start), [], {}
    for at, step in enumerate(draw(st.lists(st.sampled_from(STEPS), max_size=7))):
        name, axis = f"c{at}", draw(st.integers(0, len(shape) - 1))
        if step == "expand":
            ones = [draw(st.integers(2, 3)) if size == 1 else size for size in shape]
            shape = [*draw(st.lists(st.integers(1, 3), max_size=1)), *ones]
            weights[name] = integers(*shape)
            call = f"Expand(v{at}, {name})"
        elif step == "tile":
            times = [1 + (each == axis) for each in range(len(shape))]
            shape = [size * many for size, many in zip(shape, times, strict=True)]
            weights[name] = integers(*times)
            call = f"Tile(v{at}, {name})"
        elif step in ("merge", "split"):
            if step == "merge":
                shape = [
                    *shape[:axis],
                    math.prod(shape[axis : axis + 2]),
                    *shape[axis + 2 :],
                ]
            else:
                low = draw(
                    st.sampled_from([n for n in (1, 2, 3) if shape[axis] % n == 0])
                )
                shape = [*shape[:axis], shape[axis] // low, low, *shape[axis + 1 :]]
            weights[name] = integers(*shape)
            call = f"Reshape(v{at}, {name})"
        elif step == "turn":
            order = draw(st.permutations(range(len(shape))))
            shape = [shape[each] for each in order]
            call = f"Transpose<perm = {order}>(v{at})"
        elif step == "unary":
            call = f"Tanh(v{at})"
        elif step == "sum":
            sizes = [draw(st.sampled_from([1, size])) for size in shape]
            weights[name] = RANDOM.normal(
                size=sizes[draw(st.integers(0, len(shape))) :]
            )
            call = f"Sub({name}, v{at})"
        elif step == "softmax":
            call = f"Softmax<axis = -1>(v{at})"
        elif step == "reduce":
            shape = [*shape[:-1], 1]
            call = f"ReduceMean<axes = [-1]>(v{at})"
        elif step == "join":
            more = [1 if each == axis else size for each, size in enumerate(shape)]
            once = [draw(st.sampled_from([1, size])) for size in more]
            weights[name] = np.broadcast_to(RANDOM.normal(size=once), more).copy()
            shape[axis] += 1
            call = f"Concat<axis = {axis}>(v{at}, {name})"
        else:
            shape[axis] *= 2
            call = f"Concat<axis = {axis}>(v{at}, v{at})"
        steps.append(f"v{at + 1} = {call}")
    result = ",".join("ABCDEFGHIJKLM"[: len(shape)])
    body = f"v0 = Neg(x) {' '.join(steps)} y = Neg(v{len(steps)})"
    return graph_of(f"(double{start} x) => (double[{result}] y)", body), weights


def computed(model: ir.Model) -> int:
    """Return how many numbers the operators that compute put out."""
    kinds = ("Neg", "ReduceMean", "Softmax", "Sub", "Tanh")
    return sum(
        math.prod(static_shape(node.outputs[0]) or ())
        for node in model.graph
        if node.op_type in kinds
    )


@hypothesis.given(repetitions())
@hypothesis.settings(max_examples=scaled(150))
def test_any_chain_of_repetitions_views_and_operators(
    drawn: tuple[str, dict[str, Any]],
) -> None:
    """Sizes this small never pay: here a byte costs what starting a node does."""
    text, weights = drawn
    model = read(text, **weights)
    infer_shapes(model)
    size = computed(model)
    feeds = {"x": RANDOM.normal(size=static_shape(model.graph.inputs[0]) or ())}
    (want,) = compute(model, feeds)
    with pytest.MonkeyPatch.context() as patch:
        for module in (work, repeats):
            patch.setattr(module, "MOVED_BYTES_PER_NODE", 1)
        changes = HoistLinear().run(model, NO_MODULES).changes
        infer_shapes(model, strict=True)
        hypothesis.event(f"changes: {min(changes, 3)}")
        assert HoistLinear().run(model, NO_MODULES).changes == 0
    assert computed(model) <= size
    (got,) = compute(model, feeds)
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-9 * np.abs(want).max())
