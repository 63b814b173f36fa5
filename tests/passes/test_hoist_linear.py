"""Products in front of what repeats their rows; the algebra says how many are left."""

from typing import Any

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.graph import infer_shapes
from me2e_compress.passes.hoist_linear import HoistLinear, sums
from tests.passes.hoisted import graph_of, hoist, integers, products
from tests.passes.small import NO_MODULES, apply, normal, ops, read
from tests.support.calls import calls

ROWS, TIMES, WIDE = 101, 60, 32

MOTION_DECODER = graph_of(
    f"(float[1,{ROWS},{WIDE}] map, float[{TIMES},{ROWS},2] position)"
    f" => (float[{TIMES},{ROWS},{WIDE}] keys, float[{TIMES},{ROWS},{WIDE}] values)",
    "repeated = Tile(map, times)  linear = MatMul(position, p)"
    " embedded = Add(linear, c)  query = Add(repeated, embedded)"
    " key = MatMul(query, wk)  keys = Add(key, bk)"
    " value = MatMul(repeated, wv)  values = Add(value, bv)",
)


def test_the_keys_and_values_of_a_motion_decoder() -> None:
    model = hoist(
        MOTION_DECODER,
        times=integers(TIMES, 1, 1), p=normal(2, WIDE), c=normal(WIDE),
        wk=normal(WIDE, WIDE), bk=normal(WIDE),
        wv=normal(WIDE, WIDE), bv=normal(WIDE),
    )  # fmt: skip
    assert products(model) == 2 * ROWS * WIDE**2 + TIMES * ROWS * 2 * WIDE
    assert ops(model).count("Expand") == 1, "the Add of the keys repeats by itself"


CAMERAS, QUERIES = 6, 500

HOISTED: dict[str, tuple[str, str, dict[str, Any], int, list[str]]] = {
    "two layers in a row become one": (
        "(float[1,4000,16] x) => (float[1,4000,32] y)",
        "a = MatMul(x, v)  b = Add(a, c)  t = Transpose<perm = [1, 0, 2]>(b)"
        " r = Reshape(t, s)  z = MatMul(r, w)  y = Add(z, d)",
        {
            "v": normal(16, 64), "c": normal(64), "s": integers(1, 4000, 64),
            "w": normal(64, 32), "d": normal(32),
        },
        4000 * 16 * 32,
        ["MatMul"],
    ),
    "a difference keeps its sign": (
        "(float[1,8,32] x, float[400,8,2] q) => (float[400,8,32] y)",
        "p = MatMul(q, v)  r = Add(p, c)  d = Sub(r, x)  y = MatMul(d, w)",
        {"v": normal(2, 32), "c": normal(32), "w": normal(32, 32)},
        8 * 32 * 32 + 3200 * 2 * 32,
        ["MatMul", "MatMul"],
    ),
    "a shared repetition stays for its other readers": (
        f"(float[1,{ROWS},{WIDE}] x) => (float[{TIMES},{ROWS},{WIDE}] y,"
        f" float[{TIMES},{ROWS},{WIDE}] z)",
        "z = Tile(x, t)  y = MatMul(z, w)",
        {"t": integers(TIMES, 1, 1), "w": normal(WIDE, WIDE)},
        ROWS * WIDE**2,
        ["Expand", "MatMul", "Tile"],
    ),
    "a copy for every camera is multiplied once": (
        f"(float[4,{QUERIES},{WIDE}] x) => (float[24,{QUERIES},{WIDE}] y)",
        "many = Concat<axis = 0>(x, x, x, x, x, x)  placed = Relu(many)"
        " z = MatMul(placed, w)  y = Add(z, b)",
        {"w": normal(WIDE, WIDE), "b": normal(WIDE)},
        4 * QUERIES * WIDE**2,
        ["Add", "Expand", "MatMul", "Relu", "Reshape", "Reshape"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", HOISTED)
def test_what_is_multiplied_once(case: str) -> None:
    ports, body, weights, count, left = HOISTED[case]
    model = hoist(graph_of(ports, body), **weights)
    assert products(model) == count
    kinds = sorted(ops(model))
    assert [kind for kind in kinds if kind in left] == left


STAY = {
    "a relu between two layers": (
        "a = MatMul(x, v)  b = Relu(a)  y = MatMul(b, w)",
        {"v": normal(16, 64), "w": normal(64, 32)},
    ),
    "a smaller bottleneck": (
        "a = MatMul(x, v)  y = MatMul(a, w)",
        {"v": normal(16, 2), "w": normal(2, 32)},
    ),
    "a sum of as many rows": (
        "a = Relu(x)  b = Add(a, x)  y = MatMul(b, w)",
        {"w": normal(16, 32)},
    ),
    "rows that are chosen": (
        "a = Slice(x, from, to, axes)  y = MatMul(a, w)",
        {
            "from": integers(5),
            "to": integers(9),
            "axes": integers(1),
            "w": normal(16, 32),
        },
    ),
    "weights that would overflow": (
        "a = MatMul(x, v)  y = MatMul(a, w)",
        {"v": np.full((16, 64), 3e4, np.float16), "w": np.ones((64, 32), np.float16)},
    ),
    "open sizes": (
        "a = Tile(x, t)  y = MatMul(a, w)",
        {"t": integers(50, 1, 1), "w": normal(16, 32)},
    ),
    "a last axis that is turned": (
        "a = Transpose<perm = [0, 2, 1]>(x)  b = Tile(a, t)  y = MatMul(b, w)",
        {"t": integers(1, 1, 2), "w": normal(8000, 3)},
    ),
}


@pytest.mark.parametrize("case", STAY)
def test_what_saves_nothing_stays(case: str) -> None:
    body, weights = STAY[case]
    kind = "float16" if "overflow" in case else "float"
    rows = "N,101" if "open" in case else "1,4000"
    text = graph_of(f"({kind}[{rows},16] x) => ({kind}[A,B,C] y)", body)
    model = read(text, **weights)
    assert apply(HoistLinear(), model).changes == 0


def test_new_weights_must_be_worth_their_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    """100 constant rows to keep, for 100 x 32 x 1024 products a frame: not worth it."""
    text = graph_of(
        "(float[1,1,32] x) => (float[1,100,1024] y)",
        "many = Add(x, table)  y = MatMul(many, w)",
    )
    weights = {"table": normal(100, 32), "w": normal(32, 1024)}
    model = read(text, **weights)
    assert apply(HoistLinear(), model).changes == 0
    model = read(text, **weights)
    monkeypatch.setattr(sums, "BYTES_PER_NODE", 1_000_000)
    apply(HoistLinear(), model)
    assert products(model) == 32 * 1024


def of(op_type: str, model: ir.Model) -> ir.Node:
    return next(node for node in model.graph if node.op_type == op_type)


@pytest.mark.parametrize("version", [13, 17])
@pytest.mark.parametrize("operator", ["Softmax", "LogSoftmax"])
def test_the_default_axis_of_a_softmax(operator: str, version: int) -> None:
    text = graph_of(
        "(float[1,4,32] a) => (float[20,4,32] y)",
        f"b = Expand(a, many)  y = {operator}(b)",
        version,
    )

    model = hoist(text, many=integers(20, 4, 32))

    assert of(operator, model).outputs[0].shape == (1, 4, 32)


@pytest.mark.parametrize(("scale", "rows"), [((32,), 1), ((6, 32), 6)])
def test_a_scale_for_every_row_is_not_moved(scale: tuple[int, ...], rows: int) -> None:
    text = graph_of(
        "(float[20,1,32] a) => (float[20,6,32] y)",
        "b = Expand(a, many)  y = LayerNormalization<axis = -1>(b, g)",
    )

    model = hoist(text, many=integers(20, 6, 32), g=normal(*scale))

    assert of("LayerNormalization", model).outputs[0].shape == (20, rows, 32)


def copies(count: int) -> ir.Model:
    """Many products of repeated rows, each an output of the graph."""
    body = "".join(
        f"t{at} = Expand(x{at}, shape)  y{at} = MatMul(t{at}, w)  "
        for at in range(count)
    )
    inputs = ", ".join(f"float[1,4,16] x{at}" for at in range(count))
    outputs = ", ".join(f"float[64,4,16] y{at}" for at in range(count))
    text = graph_of(f"({inputs}) => ({outputs})", body)
    model = read(text, w=normal(16, 16), shape=integers(64, 4, 16))
    infer_shapes(model)
    return model


def test_the_work_is_linear_in_the_rewrites_even_of_outputs() -> None:
    few, many = copies(20), copies(80)

    least = calls(lambda: HoistLinear().run(few, NO_MODULES))
    most = calls(lambda: HoistLinear().run(many, NO_MODULES))

    assert most < 5 * least


def test_a_sum_of_thousands_of_terms_in_front_of_a_product() -> None:
    terms = 1200
    added = "".join(f"z{at} = Add(z{at - 1}, x)  " for at in range(1, terms))
    body = f"z0 = Relu(x)  {added} y = MatMul(z{terms - 1}, w)"
    model = read(graph_of("(float[4,16] x) => (float[4,16] y)", body), w=normal(16, 16))
    infer_shapes(model)

    assert HoistLinear().run(model, NO_MODULES).changes == 0
