"""Products in front of what repeats their rows; the algebra says how many are left."""

import numpy as np
import pytest

from me2e_compress.graph import provenance
from me2e_compress.passes.fold_constants import FoldConstants
from me2e_compress.passes.hoist_linear import HoistLinear
from tests.passes.hoisted import (
    difference,
    graph_of,
    hoist,
    integers,
    normal,
    products,
)
from tests.passes.small import apply, ops, read

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

SAMPLING = (
    f"(float[1,{QUERIES},{WIDE}] x) => (float[{CAMERAS},{QUERIES},16] offsets,"
    f" float[{CAMERAS},{QUERIES},8] weights)",
    " placed = Add(many, position)"
    " query = LayerNormalization<axis = -1>(placed, gamma, beta)"
    " flat = Reshape(query, rows)"
    " off = Gemm<transB = 1>(flat, wo, bo)  offsets = Reshape(off, offset_shape)"
    " product = MatMul(query, ww)  weights = Add(product, bw)",
)


REPEATS = {
    "Expand": "many = Expand(x, cameras)",
    "Tile": "many = Tile(x, times)",
    "stack": "many = Concat<axis = 0>(x, x, x, x, x, x)",
}


@pytest.mark.parametrize("repeat", REPEATS)
def test_sampling_offsets_and_weights_of_queries_repeated_for_cameras(
    repeat: str,
) -> None:
    model = hoist(
        graph_of(SAMPLING[0], REPEATS[repeat] + SAMPLING[1]),
        times=integers(CAMERAS, 1, 1),
        cameras=integers(CAMERAS, QUERIES, WIDE), position=normal(QUERIES, WIDE),
        gamma=normal(WIDE), beta=normal(WIDE), rows=integers(-1, WIDE),
        wo=normal(16, WIDE), bo=normal(16), ww=normal(WIDE, 8), bw=normal(8),
        offset_shape=integers(CAMERAS, QUERIES, 16),
    )  # fmt: skip
    assert products(model) == QUERIES * WIDE * (16 + 8)
    assert ops(model)[:2] == ["Add", "LayerNormalization"]


def test_a_self_attention_of_constants_is_folded_and_its_product_not_repeated() -> None:
    text = graph_of(
        f"(float[1,1,{WIDE}] memory) => (float[1,200,{WIDE}] y)",
        "q = MatMul(queries, wq)  turned = Transpose<perm = [0, 2, 1]>(queries)"
        " scores = MatMul(q, turned)  p = Softmax<axis = -1>(scores)"
        " mixed = MatMul(p, queries)  seen = Expand(memory, many)"
        " both = Add(mixed, seen)  y = MatMul(both, w)",
    )
    weights = {
        "queries": normal(1, 200, WIDE),
        "wq": normal(WIDE, WIDE) / WIDE,
        "many": integers(1, 200, WIDE),
        "w": normal(WIDE, WIDE),
    }
    model = read(text, **weights)
    apply(FoldConstants(), model)
    apply(HoistLinear(), model)
    assert products(model) == WIDE**2
    assert difference(model, text, weights) < 1e-5


def test_two_layers_in_a_row_become_one() -> None:
    model = hoist(
        graph_of(
            "(float[1,4000,16] x) => (float[1,4000,32] y)",
            "a = MatMul(x, v)  b = Add(a, c)  t = Transpose<perm = [1, 0, 2]>(b)"
            " r = Reshape(t, s)  z = MatMul(r, w)  y = Add(z, d)",
        ),
        v=normal(16, 64), c=normal(64), s=integers(1, 4000, 64),
        w=normal(64, 32), d=normal(32),
    )  # fmt: skip
    assert products(model) == 4000 * 16 * 32
    assert ops(model).count("MatMul") == 1


def test_a_difference_keeps_its_sign() -> None:
    model = hoist(
        graph_of(
            "(float[1,8,32] x, float[400,8,2] q) => (float[400,8,32] y)",
            "p = MatMul(q, v)  r = Add(p, c)  d = Sub(r, x)  y = MatMul(d, w)",
        ),
        v=normal(2, 32), c=normal(32), w=normal(32, 32),
    )  # fmt: skip
    assert products(model) == 8 * 32 * 32 + 3200 * 2 * 32


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
    "a last axis that is turned": (
        "a = Transpose<perm = [0, 2, 1]>(x)  b = Tile(a, t)  y = MatMul(b, w)",
        {"t": integers(1, 1, 2), "w": normal(8000, 3)},
    ),
}


@pytest.mark.parametrize("case", STAY)
def test_what_saves_nothing_stays(case: str) -> None:
    body, weights = STAY[case]
    text = graph_of("(float[1,4000,16] x) => (float[A,B,C] y)", body)
    model = read(text, **weights)
    assert apply(HoistLinear(), model).changes == 0


def test_new_weights_must_be_worth_their_bytes() -> None:
    """100 constant rows to keep, for 100 x 32 x 1024 products a frame: not worth it."""
    text = graph_of(
        "(float[1,1,32] x) => (float[1,100,1024] y)",
        "many = Add(x, table)  y = MatMul(many, w)",
    )
    weights = {"table": normal(100, 32), "w": normal(32, 1024)}
    model = read(text, **weights)
    assert apply(HoistLinear(), model).changes == 0
    model = read(text, **weights)
    apply(HoistLinear(bytes_per_node=1_000_000), model)
    assert products(model) == 32 * 1024


def test_weights_that_would_overflow_stay_apart() -> None:
    big = np.full((16, 64), 3e4, np.float16)
    text = graph_of(
        "(float16[1,4000,16] x) => (float16[1,4000,32] y)",
        "a = MatMul(x, v)  y = MatMul(a, w)",
    )
    model = read(text, v=big, w=np.ones((64, 32), np.float16))
    assert apply(HoistLinear(), model).changes == 0


def test_open_sizes_are_left_alone() -> None:
    text = graph_of(
        "(float[N,101,32] x) => (float[A,B,32] y)",
        "a = Tile(x, t)  y = MatMul(a, w)",
    )
    model = read(text, t=integers(50, 1, 1), w=normal(32, 32))
    assert apply(HoistLinear(), model).changes == 0


def test_a_shared_repetition_stays_for_its_other_readers() -> None:
    model = hoist(
        graph_of(
            f"(float[1,{ROWS},{WIDE}] x) => (float[{TIMES},{ROWS},{WIDE}] y,"
            f" float[{TIMES},{ROWS},{WIDE}] z)",
            "z = Tile(x, t)  y = MatMul(z, w)",
        ),
        t=integers(TIMES, 1, 1), w=normal(WIDE, WIDE),
    )  # fmt: skip
    assert products(model) == ROWS * WIDE**2
    assert sorted(ops(model)) == ["Expand", "MatMul", "Tile"]


def test_new_nodes_know_their_module_and_every_origin() -> None:
    model = read(
        graph_of(
            "(float[1,100,32] x) => (float[100,100,32] y)",
            '["many"] a = Tile(x, t)  ["product"] b = MatMul(a, w)'
            ' ["bias"] y = Add(b, c)',
        ),
        t=integers(100, 1, 1), w=normal(32, 32), c=normal(32),
    )  # fmt: skip
    apply(HoistLinear(), model)
    assert ops(model) == ["MatMul", "Add", "Expand"]
    origins = []
    for node in model.graph:
        past = provenance.read(node)
        assert past is not None
        assert past.passes == ("hoist-linear",)
        origins.append(set(past.origins))
    assert origins == [{"product"}, {"bias"}, {"many", "product", "bias"}]


def test_a_decomposed_layer_norm_of_repeated_rows_is_computed_once() -> None:
    model = hoist(
        graph_of(
            f"(float[1,{QUERIES},{WIDE}] x) => (float[{CAMERAS},{QUERIES},16] y)",
            "many = Expand(x, cameras)  mean = ReduceMean<axes = [-1]>(many)"
            " centred = Sub(many, mean)  square = Pow(centred, two)"
            " variance = ReduceMean<axes = [2]>(square)  safe = Add(variance, tiny)"
            " deviation = Sqrt(safe)  normal = Div(centred, deviation)"
            " scaled = Mul(normal, gamma)  y = MatMul(scaled, w)",
        ),
        cameras=integers(CAMERAS, QUERIES, WIDE), two=normal(1)[0] * 0 + 2,
        tiny=normal(1)[0] * 0 + 1e-5, gamma=normal(WIDE), w=normal(WIDE, 16),
    )  # fmt: skip
    assert products(model) == QUERIES * WIDE * 16
    assert ops(model)[-1] == "Expand"
    assert ops(model).count("Expand") == 1


def test_a_copy_for_every_camera_is_multiplied_once() -> None:
    model = hoist(
        graph_of(
            f"(float[4,{QUERIES},{WIDE}] x) => (float[24,{QUERIES},{WIDE}] y)",
            "many = Concat<axis = 0>(x, x, x, x, x, x)  placed = Relu(many)"
            " z = MatMul(placed, w)  y = Add(z, b)",
        ),
        w=normal(WIDE, WIDE), b=normal(WIDE),
    )  # fmt: skip
    assert products(model) == 4 * QUERIES * WIDE**2
    assert ops(model) == ["Reshape", "Relu", "MatMul", "Add", "Expand", "Reshape"]
