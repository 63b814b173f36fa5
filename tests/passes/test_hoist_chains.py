"""Any chain behind a repetition: less work, the same numbers."""

import math
from typing import Any

import hypothesis
import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import strategies as st

from me2e_compress.graph import infer_shapes, static_shape
from me2e_compress.passes import work
from me2e_compress.passes.hoist_linear import HoistLinear, repeats
from tests.passes.hoisted import graph_of, integers
from tests.passes.small import NO_MODULES, RANDOM, compute, read
from tests.support.profiles import scaled

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
                shape[axis : axis + 2] = [math.prod(shape[axis : axis + 2])]
            else:
                divisors = [n for n in (1, 2, 3) if shape[axis] % n == 0]
                low = draw(st.sampled_from(divisors))
                shape[axis : axis + 1] = [shape[axis] // low, low]
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
            del sizes[: draw(st.integers(0, len(shape)))]
            weights[name] = RANDOM.normal(size=sizes)
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
@hypothesis.settings(max_examples=scaled(80))
def test_any_chain_behind_a_repetition(drawn: tuple[str, dict[str, Any]]) -> None:
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
