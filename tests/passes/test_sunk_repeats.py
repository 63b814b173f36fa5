"""What repeats is computed once, whatever regroups its axes before it is read."""

import math
import re
from typing import Any

import hypothesis
import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import strategies as st

from me2e_compress.graph import infer_shapes, static_shape
from me2e_compress.passes import work
from me2e_compress.passes.hoist_linear import HoistLinear, sunk_repeats
from tests.passes.hoisted import RANDOM, graph_of, hoist, integers, normal, products
from tests.passes.small import NO_MODULES, apply, compute, ops, read
from tests.profiles import scaled

CAMERAS, CELLS, WIDE = 6, 200, 32
FORMS = {
    "Tile": "u = Unsqueeze(x, one) t = Tile(u, times) q = Reshape(t, rows)",
    "Expand": "u = Unsqueeze(x, one) t = Expand(u, many) q = Reshape(t, rows)",
    "torch.cat": "q = Concat<axis = 0>(x, x, x, x, x, x)",
    "torch.stack": (
        "u = Unsqueeze(x, one) t = Concat<axis = 1>(u, u, u, u, u, u)"
        " q = Reshape(t, rows)"
    ),
    "cameras behind cells": (
        "c = Reshape(x, cells) t = Expand(c, last) q = Transpose<perm = [1, 0, 2]>(t)"
    ),
    "position added before": (
        "p = Add(x, position) u = Unsqueeze(p, one) t = Tile(u, times)"
        " q = Reshape(t, rows)"
    ),
    "position added behind": (
        "u = Unsqueeze(x, one) t = Tile(u, times) r = Reshape(t, rows)"
        " q = Add(r, position)"
    ),
    "position repeated too": (
        "u = Unsqueeze(x, one) t = Tile(u, times) r = Reshape(t, rows)"
        " v = Unsqueeze(position, one) s = Tile(v, times) p = Reshape(s, rows)"
        " q = Add(p, r)"
    ),
}
OFFSETS = (
    "o = MatMul(q, wo) b = Add(o, bo) six = Reshape(b, points) d = Div(six, size)"
    " z = Reshape(d, pillars) a = Add(reference, z) places = Reshape(a, points)"
)
WEIGHTS = (
    "w = MatMul(q, ww) h = Add(bw, w) heads = Reshape(h, split)"
    " s8 = Softmax<axis = -1>(heads) shares = Reshape(s8, levels)"
)
LEAD = (CAMERAS, CELLS, 8)
PORTS = (
    f"(float[1,{CELLS},{WIDE}] x, float[{CAMERAS},{CELLS},1,1,4,2] reference)"
    f" => (float[{CAMERAS},{CELLS},8,1,8,2] places, float[{CAMERAS},{CELLS},8,1,8]"
    " shares)"
)
GIVEN = {
    "one": integers(1), "times": integers(1, CAMERAS, 1, 1),
    "rows": integers(CAMERAS, CELLS, WIDE), "many": integers(1, CAMERAS, CELLS, WIDE),
    "cells": integers(CELLS, 1, WIDE), "last": integers(CELLS, CAMERAS, WIDE),
    "position": normal(1, CELLS, WIDE), "size": np.abs(normal(1, 1, 1, 1, 1, 2)) + 1,
    "points": integers(*LEAD, 1, 8, 2), "pillars": integers(*LEAD, 2, 4, 2),
    "split": integers(*LEAD, 8), "levels": integers(*LEAD, 1, 8),
    "wo": normal(WIDE, 128), "bo": normal(128),
    "ww": normal(WIDE, 64), "bw": normal(64), "each": normal(CAMERAS, CELLS, WIDE),
    "flat": integers(CAMERAS * CELLS, WIDE), "flats": normal(CAMERAS * CELLS, WIDE),
    "twice": integers(2 * CELLS), "three": integers(3, 1), "zero": integers(0),
    "two": integers(2), "small": integers(CAMERAS, 2, WIDE),
}  # fmt: skip


def used(body: str) -> dict[str, Any]:
    return {name: GIVEN[name] for name in re.findall(r"\w+", body) if name in GIVEN}


def rows_of(model: ir.Model, *op_types: str) -> set[int | None]:
    """Return the sizes of the first axis of what some operators make."""
    found = [node.outputs[0] for node in model.graph if node.op_type in op_types]
    return {(static_shape(value) or (None,))[0] for value in found}


@pytest.mark.parametrize("form", FORMS)
def test_offsets_and_weights_of_one_query_for_six_cameras(form: str) -> None:
    body = f"{FORMS[form]} {OFFSETS} {WEIGHTS}"

    model = hoist(graph_of(PORTS, body), **used(body))

    assert products(model) == CELLS * WIDE * (128 + 64)
    assert rows_of(model, "MatMul", "Div", "Softmax") == {1}
    assert ops(model).count("Expand") == 1, "the sum with the points repeats by itself"
    assert not {"Concat", "Tile"} & set(ops(model))


def test_a_repeated_constant_beside_repeated_rows_is_stored_once() -> None:
    """The vehicle's own row, the same for each of 300 agents, behind 100 others."""
    body = (
        "t = Tile(a, times) c = Concat<axis = 1>(t, ego)"
        " p = Transpose<perm = [1, 0, 2]>(c) y = MatMul(p, w)"
    )
    rows = {"ego": np.repeat(normal(1, 1, 32), 300, 0), "times": integers(300, 1, 1)}
    text = graph_of("(float[1,100,32] a) => (float[101,300,32] y)", body)

    model = hoist(text, **rows, w=normal(32, 32))

    assert products(model) == 100 * 32**2
    assert rows_of(model, "Concat") == {1}
    rows["ego"][7, 0, 3] += 1.0
    other = hoist(text, **rows, w=normal(32, 32))
    assert rows_of(other, "Concat") == {300}


DIFFERS = {
    "offsets that differ by camera": (
        "t = Tile(x, times) r = Reshape(t, rows) a = Add(r, each) y = Relu(a)",
        {"Add": 6, "Relu": 6},
    ),
    "a softmax over cameras": (
        "t = Tile(x, times) r = Reshape(t, rows) u = Transpose<perm = [1, 2, 0]>(r)"
        " y = Softmax<axis = -1>(u)",
        {"Softmax": CELLS},
    ),
    "a tiled query that is read by camera, too": (
        "t = Tile(x, times) r = Reshape(t, rows) e = Exp(r) y = Mul(each, e)",
        {"Exp": 1, "Mul": 6},
    ),
    "flat rows that differ by camera": (
        "t = Tile(x, times) r = Reshape(t, flat) a = Add(r, flats)"
        " y = Reshape(a, rows)",
        {"Add": 6 * CELLS},
    ),
    "flat rows that repeat otherwise": (
        "t = Tile(x, times) r = Reshape(t, flat)"
        " p = Slice(flats, zero, twice, zero) s = Tanh(p) q = Tile(s, three)"
        " a = Add(r, q) y = Reshape(a, rows)",
        {"Add": 6 * CELLS},
    ),
    "rows behind each other along the repeated axis": (
        "t = Tile(x, times) r = Reshape(t, rows) y = Concat<axis = 0>(r, position)",
        {"Concat": 7},
    ),
    "few rows that others read, too": (
        "s = Slice(x, zero, two, two) t = Tile(s, times) r = Reshape(t, small)"
        " g = Sigmoid(r) y = Concat<axis = 0>(g, r)",
        {"Sigmoid": 6},
    ),
}


def test_flat_rows_are_regrouped_behind_what_is_computed_once() -> None:
    body = (
        "t = Tile(x, times) r = Reshape(t, flat) v = Tile(position, times)"
        " p = Reshape(v, flat) a = Add(r, p) e = Tanh(a) y = Add(e, flats)"
    )
    text = graph_of(
        f"(float[1,1,{CELLS},{WIDE}] x, float[1,1,{CELLS},{WIDE}] position)"
        f" => (float[{CAMERAS * CELLS},{WIDE}] y)",
        body,
    )
    given = {name: each for name, each in used(body).items() if name != "position"}

    model = hoist(text, **given)

    assert rows_of(model, "Tanh") == {1}
    assert ops(model)[-3:] == ["Expand", "Reshape", "Add"]


def test_an_exponent_of_another_type_stays_repeated() -> None:
    text = graph_of(
        f"(float[1,1,{CELLS},{WIDE}] x, int64[1,1,{CELLS},{WIDE}] n)"
        f" => (float[{CAMERAS},{CELLS},{WIDE}] y)",
        "t = Tile(n, times) r = Reshape(t, rows) e = Reshape(x, row) y = Pow(e, r)",
    )
    row = integers(1, CELLS, WIDE)
    given = {name: GIVEN[name] for name in ("times", "rows")}

    assert apply(HoistLinear(), read(text, row=row, **given)).changes == 0


def test_what_does_not_pay_is_noted() -> None:
    body = DIFFERS["few rows that others read, too"][0]
    text = graph_of(f"(float[1,1,{CELLS},{WIDE}] x) => (float[A,B,C] y)", body)

    result = apply(HoistLinear(), read(text, **used(body)))

    assert result.notes == (
        "left 1 node behind what repeats: others read it too, or it is small",
    )


@pytest.mark.parametrize("case", DIFFERS)
def test_what_differs_by_camera_is_computed_for_each(case: str) -> None:
    body, rows = DIFFERS[case]
    text = graph_of(f"(float[1,1,{CELLS},{WIDE}] x) => (float[A,B,C] y)", body)

    model = hoist(text, **used(body))

    assert {kind: rows_of(model, kind) for kind in rows} == {
        kind: {size} for kind, size in rows.items()
    }


STEPS = (
    *("expand", "tile", "merge", "split", "turn", "unary", "sum", "softmax"),
    *("reduce", "join", "stack"),
)


@st.composite
def chains(draw: st.DrawFn) -> tuple[str, dict[str, Any]]:
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


@hypothesis.given(chains())
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
        for module in (work, sunk_repeats):
            patch.setattr(module, "MOVED_BYTES_PER_NODE", 1)
        changes = HoistLinear().run(model, NO_MODULES).changes
        infer_shapes(model, strict=True)
        hypothesis.event(f"changes: {min(changes, 3)}")
        assert HoistLinear().run(model, NO_MODULES).changes == 0
    assert computed(model) <= size
    (got,) = compute(model, feeds)
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-9 * np.abs(want).max())
