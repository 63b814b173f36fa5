"""Products in front of what repeats their rows; the algebra says how many are left."""

import math
from typing import Any

import hypothesis
import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import strategies as st

from me2e_compress.graph import infer_shapes, macs, provenance, static_shape
from me2e_compress.passes.fold_constants import FoldConstants
from me2e_compress.passes.hoist_linear import HoistLinear, least_work
from tests.passes.small import NO_MODULES, apply, compute, ops, read

RANDOM = np.random.default_rng(3)


def normal(*shape: int) -> Any:
    return RANDOM.normal(size=shape).astype(np.float32)


def integers(*values: int) -> Any:
    return np.array(values, np.int64)


def graph_of(signature: str, body: str, version: int = 17) -> str:
    return (
        f'<ir_version: 8, opset_import: ["" : {version}]>\ng {signature} {{ {body} }}'
    )


def products(model: ir.Model) -> int:
    return sum(macs(node) or 0 for node in model.graph)


def difference(model: ir.Model, text: str, weights: dict[str, Any]) -> float:
    """Return the largest gap to the text in float64, relative to the largest value."""
    double = {
        name: array.astype(np.float64) if array.dtype == np.float32 else array
        for name, array in weights.items()
    }
    feeds = {
        port.name or "": normal(*(static_shape(port) or ()))
        for port in model.graph.inputs
    }
    wide = {name: array.astype(np.float64) for name, array in feeds.items()}
    wanted = compute(read(text.replace("float[", "double["), **double), wide)
    worst = 0.0
    for want, got in zip(wanted, compute(model, feeds), strict=True):
        assert want.shape == got.shape
        worst = max(worst, float(np.abs(want - got).max() / np.abs(want).max()))
    return worst


def hoist(text: str, **weights: Any) -> ir.Model:
    """Apply the pass under its contract; outputs are those of float64 within 1e-5."""
    model = read(text, **weights)
    apply(HoistLinear(), model)
    assert difference(model, text, weights) < 1e-5
    return model


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
    assert ops(model).count("Tile") == 1, "the Add of the keys repeats by itself"


CAMERAS, QUERIES = 6, 500

SAMPLING = graph_of(
    f"(float[1,{QUERIES},{WIDE}] x) => (float[{CAMERAS},{QUERIES},16] offsets,"
    f" float[{CAMERAS},{QUERIES},8] weights)",
    "many = Expand(x, cameras)  placed = Add(many, position)"
    " query = LayerNormalization<axis = -1>(placed, gamma, beta)"
    " flat = Reshape(query, rows)"
    " off = Gemm<transB = 1>(flat, wo, bo)  offsets = Reshape(off, offset_shape)"
    " product = MatMul(query, ww)  weights = Add(product, bw)",
)


def test_sampling_offsets_and_weights_of_queries_repeated_for_cameras() -> None:
    model = hoist(
        SAMPLING,
        cameras=integers(CAMERAS, QUERIES, WIDE), position=normal(QUERIES, WIDE),
        gamma=normal(WIDE), beta=normal(WIDE), rows=integers(-1, WIDE),
        wo=normal(16, WIDE), bo=normal(16), ww=normal(WIDE, 8), bw=normal(8),
        offset_shape=integers(CAMERAS, QUERIES, 16),
    )  # fmt: skip
    assert products(model) == QUERIES * WIDE * (16 + 8)
    names = ops(model)
    assert names.index("LayerNormalization") < names.index("Expand")


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


def test_columns_side_by_side_of_which_some_are_repeated() -> None:
    model = hoist(
        graph_of(
            "(float[1,50,20,24] x, float[1,50,1,96] most) => (float[1,50,20,64] y)",
            "many = Expand(most, shape)  both = Concat<axis = -1>(x, many)"
            " z = MatMul(both, w)  y = Add(z, b)",
        ),
        shape=integers(1, 50, 20, 96), w=normal(120, 64), b=normal(64),
    )  # fmt: skip
    assert products(model) == 1000 * 24 * 64 + 50 * 96 * 64


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
    assert ops(model).count("Tile") == 2


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
    assert ops(model) == ["MatMul", "Add", "Tile"]
    for node in model.graph:
        past = provenance.read(node)
        assert past is not None
        assert past.passes == ("hoist-linear",)
        assert {"product", "bias"} <= set(past.origins)
        assert (node.op_type == "Tile") == ("many" in past.origins)


MOVES = (
    "expand",
    "tile",
    "gather",
    "reshape",
    "transpose",
    "unsqueeze",
    "slice",
    "add",
)


@st.composite
def chains(draw: st.DrawFn) -> tuple[str, dict[str, Any]]:
    """A value that is rearranged, repeated and added to, and then multiplied."""
    width = draw(st.integers(1, 6))
    shape = [draw(st.integers(1, 3)), draw(st.integers(1, 4)), width]
    start = list(shape)
    weights: dict[str, Any] = {"w": normal(width, draw(st.integers(1, 5)))}
    steps: list[str] = []
    for index, move in enumerate(draw(st.lists(st.sampled_from(MOVES), max_size=6))):
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
        else:
            weights[name] = normal(*draw(st.sampled_from([[width], [1, width], shape])))
            call = f"{draw(st.sampled_from(['Add', 'Sub']))}(v{index}, {name})"
        steps.append(f"v{index + 1} = {call}")
    body = f"v0 = Neg(x) {' '.join(steps)} y = MatMul(v{len(steps)}, w)"
    result = ",".join("ABCDEFGHIJK"[: len(shape)])
    text = graph_of(f"(float{start} x) => (float[{result}] y)", body)
    return text.replace("float[1 ", "float[1"), weights


@hypothesis.given(chains())
@hypothesis.settings(max_examples=60, deadline=None)
def test_any_chain_in_front_of_a_product(drawn: tuple[str, dict[str, Any]]) -> None:
    """Products this small never pay: here one costs what starting a node does."""
    text, weights = drawn
    model = read(text, **weights)
    infer_shapes(model)
    before = products(model)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(least_work, "MACS_PER_NODE", 1)
        changes = HoistLinear(bytes_per_node=10**9).run(model, NO_MODULES).changes
    hypothesis.event(f"changes: {min(changes, 1)}")
    infer_shapes(model, strict=True)
    assert products(model) < before if changes else products(model) == before
    assert difference(model, text, weights) < 1e-5
