"""What repeats is computed once, whatever regroups its axes before it is read."""

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.graph import static_shape
from me2e_compress.passes.hoist_linear import HoistLinear
from tests.passes.hoisted import graph_of, hoist, integers, products
from tests.passes.small import apply, normal, ops, read

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


def rows_of(model: ir.Model, *op_types: str) -> set[int | None]:
    """Return the sizes of the first axis of what some operators make."""
    result = [node.outputs[0] for node in model.graph if node.op_type in op_types]
    return {(static_shape(value) or (None,))[0] for value in result}


@pytest.mark.parametrize("form", FORMS)
def test_offsets_and_weights_of_one_query_for_six_cameras(form: str) -> None:
    body = f"{FORMS[form]} {OFFSETS} {WEIGHTS}"

    model = hoist(graph_of(PORTS, body), **GIVEN)

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

    assert products(model) == 101 * 32**2
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


def test_an_exponent_of_another_type_stays_repeated() -> None:
    text = graph_of(
        f"(float[1,1,{CELLS},{WIDE}] x, int64[1,1,{CELLS},{WIDE}] n)"
        f" => (float[{CAMERAS},{CELLS},{WIDE}] y)",
        "t = Tile(n, times) r = Reshape(t, rows) e = Reshape(x, row) y = Pow(e, r)",
    )
    row = integers(1, CELLS, WIDE)

    assert apply(HoistLinear(), read(text, row=row, **GIVEN)).changes == 0


@pytest.mark.parametrize("case", DIFFERS)
def test_what_differs_by_camera_is_computed_for_each(case: str) -> None:
    body, rows = DIFFERS[case]
    text = graph_of(f"(float[1,1,{CELLS},{WIDE}] x) => (float[A,B,C] y)", body)

    model = hoist(text, **GIVEN)

    result = {kind: rows_of(model, kind) for kind in rows}
    assert result == {kind: {size} for kind, size in rows.items()}
