"""Constant factors behind and before layers go into the weights, but for zeros."""

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.graph.rewrite import remove_dead
from me2e_compress.passes.fuse_basic import FuseBasic
from tests.passes.hoisted import integers
from tests.passes.small import apply, compute, ops, preserved, read

RANDOM = np.random.default_rng(5)
LAYERS = {
    "MatMul": "s = MatMul(x, w)",
    "sum": "a = MatMul(x, w) s = Add(b, a)",
    "rows": "f = Reshape(x, flat) s = Gemm<alpha = 0.5, beta = 2.0>(f, w, b)",
    "turned": "f = Reshape(x, flat) s = Gemm<transB = 1>(f, w, b)",
}
FORMS = {  # of offsets [batch, rows, heads * points * 2], and where the heads stand
    "heads": ("v = Reshape(s, split)", 2),
    "merged": ("u = Reshape(s, split) r = Reshape(u, rows) v = Unsqueeze(r, one)", 2),
    "swapped": (
        "u = Reshape(s, split) t = Transpose<perm = [0, 1, 3, 2, 4]>(u)"
        " v = Reshape(t, pairs)",
        2,
    ),
    "turned": ("u = Reshape(s, split) v = Transpose<perm = [2, 1, 0, 3, 4]>(u)", 0),
}


def normal(*shape: int) -> Any:
    return RANDOM.normal(size=shape)


def fused(body: str, ports: str, feeds: dict[str, Any], **weights: Any) -> list[str]:
    """Fuse in float64; outputs are equal to 1e-9 of the largest."""
    text = f"g {ports} {{ {body} }}"
    model = read(text, **weights)
    (want,) = compute(model, feeds)
    apply(FuseBasic(), model)
    (got,) = compute(model, feeds)
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-9 * np.abs(want).max())
    return ops(model)


@settings(max_examples=60, deadline=None)
@given(
    layer=st.sampled_from(sorted(LAYERS)),
    form=st.sampled_from(sorted(FORMS)),
    operator=st.sampled_from(["Mul", "Div"]),
    sizes=st.tuples(*[st.integers(1, 3)] * 4),
    varies=st.sets(st.integers(0, 4)),
    rank=st.integers(0, 5),
)
def test_a_factor_that_differs_by_column_alone_goes_into_the_layer(
    layer: str,
    form: str,
    operator: str,
    sizes: tuple[int, int, int, int],
    varies: set[int],
    rank: int,
) -> None:
    batch, rows, heads, points = sizes
    width = heads * points * 2
    view, at = FORMS[form]
    shape = [batch, rows, heads, points, 2]
    if form == "merged":
        shape[:2] = [1, batch * rows]
    if form == "swapped":
        shape[2:4] = [points * heads, 1]
    shape[at], shape[2] = shape[2], shape[at]
    factor = [size if axis in varies else 1 for axis, size in enumerate(shape)]
    factor = factor[5 - rank :]

    left = fused(
        f"{LAYERS[layer]} {view} y = {operator}(v, c)",
        f"(double[{batch},{rows},4] x) => (double[A,B,C,D,E] y)",
        {"x": normal(batch, rows, 4)},
        w=normal(*((width, 4) if layer == "turned" else (4, width))), b=normal(width),
        flat=integers(batch * rows, 4), split=integers(batch, rows, heads, points, 2),
        rows=integers(batch * rows, heads, points, 2), one=integers(0),
        pairs=integers(batch, rows, points * heads, 1, 2),
        c=np.abs(normal(*factor)) + 0.5,
    )  # fmt: skip

    columns = {at, 3, 4}
    whole = [1] * (5 - rank) + factor
    by_row = any(size > 1 and axis not in columns for axis, size in enumerate(whole))
    assert (operator in left) == by_row


@pytest.mark.parametrize(
    ("product", "shape"),
    [
        *itertools.product(["MatMul", "Gemm<transB = 1>"], [(), (1,), (1, 1), (4,)]),
        ("MatMul", (1, 1, 1)),
    ],
)
def test_a_number_before_a_layer_goes_into_it(
    product: str, shape: tuple[int, ...]
) -> None:
    stays = shape in ((4,), (1, 1, 1))
    left = fused(
        f"s = Mul(c, x) y = {product}(s, w)",
        f"(double[5,4] x) => (double[{'1,' * (len(shape) == 3)}5,8] y)",
        {"x": normal(5, 4)},
        w=normal(*((8, 4) if "transB" in product else (4, 8))),
        c=normal(*shape),
    )
    assert ("Mul" in left) == stays


STAYS = {
    "another reader of the sum": ("y = Div(v, c) z = Neg(s)", "others read too"),
    "another reader of the view": ("y = Div(v, c) z = Neg(v)", "others read too"),
    "a layer that is an output": (
        "z = MatMul(x, w) r = Reshape(z, split) y = Div(r, c)",
        "others read too",
    ),
    "a shared weight": ("y = Div(v, c) z = MatMul(x, w)", "shares its weight"),
    "a shared bias": ("y = Div(v, c) t = Neg(x) z = Add(t, b)", "shares its bias"),
    "a computed divisor": ("y = Div(v, size) z = Neg(x)", None),
    "zero": ("y = Mul(v, zero) z = Neg(x)", None),
    "tiny": ("y = Div(v, tiny) z = Neg(x)", "weight would overflow"),
    "a factor of every row": ("y = Div(v, each) z = Neg(x)", None),
    "a factor of more axes": ("y = Div(s, each) z = Neg(x)", None),
    "a column that a bias makes wide": (
        "n = MatMul(x, narrow) m = Add(n, b) k = Reshape(m, split) y = Div(k, c)"
        " z = Neg(x)",
        None,
    ),
    "a Gemm, which is reported once": (
        "f = Reshape(x, flat) g = Gemm(f, w, b) d = Div(g, tinier)"
        " y = Reshape(d, split) z = Neg(x)",
        "Gemm whose weights would overflow",
    ),
    "a scaled value of two layers": (
        "t = Mul(x, half) y = MatMul(t, w) p = MatMul(t, u) z = Neg(p)",
        "before a MatMul that others read too",
    ),
}


@pytest.mark.parametrize("case", STAYS)
def test_what_must_stay_is_left_alone_and_the_reason_noted(case: str) -> None:
    body, reason = STAYS[case]
    given = {
        "w": normal(4, 4), "u": normal(4, 4), "b": normal(4), "c": normal(2),
        "each": np.abs(normal(5, 1, 1)), "zero": normal(1) * 0, "half": normal(1),
        "tiny": np.array([1e-39, 1.0]), "tinier": np.array([1e-39] * 4),
        "narrow": normal(4, 1),
    }  # fmt: skip
    weights = {name: each.astype(np.float32) for name, each in given.items()}
    layer = "a = MatMul(x, w) s = Add(a, b) v = Reshape(s, split)"
    model = read(
        f"g (float[1,5,4] x, float[2] size) => (float[A,B,C] y, float[D,E,F] z)"
        f" {{ {layer if '(s' in body or '(v' in body else ''} {body} }}",
        split=integers(5, 2, 2), flat=integers(5, 4), **weights,
    )  # fmt: skip
    remove_dead(model.graph)

    result = apply(FuseBasic(), model)

    left = [note for note in result.notes if note.startswith("left")]
    assert result.changes == 0
    assert len(left) == (reason is not None)
    assert all(str(reason) in note for note in left)


def test_values_between_a_layer_and_its_factor_take_other_names() -> None:
    """Saved ranges, caches and dumps find a value by its name."""
    body = "a = MatMul(x, w) s = Add(b, a) v = Reshape(s, split) y = Mul(v, c)"
    model = read(
        f"g (float[2,4] x) => (float[2,3,2] y) {{ {body} }}",
        w=normal(4, 6).astype(np.float32),
        b=normal(6).astype(np.float32),
        split=integers(2, 3, 2),
        c=np.array(0.25, np.float32),
    )

    apply(FuseBasic(), model)

    assert "Mul" not in ops(model)
    values = [str(value.name) for node in model.graph for value in node.outputs]
    assert not {"a", "s", "v"} & set(values)


FACTORED = {
    "Gemm": ("Gemm(x, w, b)", "float[5,4]"),
    "MatMul": ("MatMul(x, w)", "float[5,4]"),
    "Conv": ("Conv(x, k, b)", "float[5,4,2,2]"),
}


@pytest.mark.parametrize(
    ("factor", "constant"), [("Mul", 0.0), ("Mul", -0.0), ("Div", -np.inf)]
)
@pytest.mark.parametrize("layer", FACTORED)
def test_a_factor_of_zero_stays_behind_its_layer(
    layer: str, factor: str, constant: float
) -> None:
    call, kind = FACTORED[layer]
    text = (
        f"g ({kind} x) => ({kind} y)"
        f" {{ a = {call} c = {factor}(a, z) y = Reciprocal(c) }}"
    )
    given = {
        "w": normal(4, 4), "b": normal(4), "k": normal(4, 4, 1, 1), "z": constant
    }  # fmt: skip
    weights: dict[str, Any] = {n: np.float32(each) for n, each in given.items()}

    preserved(FuseBasic(), text, **weights)
