"""Two nodes in a row that ``eliminate-redundant`` makes one of, or none."""

from typing import Any

import numpy as np
import pytest

from me2e_compress.passes.eliminate_redundant import EliminateRedundant
from tests.passes.small import apply, ops, preserved, read

MERGES: list[tuple[str, list[str] | None]] = [
    ("b = Transpose<perm = [1, 0]>(a)  c = Reshape(b, s)", None),
    ("b = Transpose<perm = [1, 0]>(a)  c = Transpose<perm = [1, 0]>(b)", []),
    ("b = Reshape(a, flat)  c = Reshape(b, s)", []),
    ("b = Unsqueeze(a, zero)  c = Squeeze(b, zero)", []),
    ("b = Reshape(a, flat)  k = Relu(b)  c = Reshape(k, s)", None),
]


@pytest.mark.parametrize(("body", "middle"), MERGES)
def test_pairs_are_merged(body: str, middle: list[str] | None) -> None:
    text = f"g (float[2,3] x) => (float[2,3] y) {{ a = Abs(x) {body} y = Neg(c) }}"
    weights: dict[str, Any] = {
        "s": np.array([2, 3]),
        "flat": np.array([6]),
        "zero": np.array([0]),
    }
    model, _ = preserved(EliminateRedundant(), text, **weights)
    if middle is not None:
        assert ops(model) == ["Abs", *middle, "Neg"]
    else:
        assert len(ops(model)) == len(ops(read(text, **weights)))


@pytest.mark.parametrize(
    ("axis", "start", "end", "left"),
    [
        (0, 0, 2, ["Abs", "Neg"]),
        (0, 2, 3, ["Exp", "Neg"]),
        (0, -1, 99, ["Exp", "Neg"]),
        (0, 0, 1, ["Abs", "Exp", "Concat", "Slice", "Neg"]),
        (0, 1, 3, ["Abs", "Exp", "Concat", "Slice", "Neg"]),
        (1, 0, 2, ["Abs", "Exp", "Concat", "Slice", "Neg"]),
    ],
)
def test_a_slice_that_takes_one_operand_of_a_concat_reads_it(
    axis: int, start: int, end: int, left: list[str]
) -> None:
    text = (
        '<ir_version: 8, opset_import: ["" : 17]>\n'
        "g (float[2,3] x, float[1,3] z) => (float[M,N] y) { a = Abs(x) b = Exp(z)"
        " both = Concat<axis = 0>(a, b) part = Slice(both, s, e, k) y = Neg(part) }"
    )
    bounds: dict[str, Any] = {
        "s": np.array([start]),
        "e": np.array([end]),
        "k": np.array([axis]),
    }
    model, _ = preserved(EliminateRedundant(), text, **bounds)
    assert ops(model) == left


def test_what_a_copied_output_says_of_shapes_is_used_at_once() -> None:
    model = read(
        """        g (float[1,8] x, int64[2] s) => (float[4,2] y, float[4,2] z)
        <int64[1] first = {0}, int64[1] last = {-1}> {
            r = Reshape(x, s)
            y = Identity(r)
            u = Unsqueeze(r, first)
            t = Transpose<perm = [1, 2, 0]>(u)
            z = Squeeze(t, last)
        }"""
    )
    apply(EliminateRedundant(), model)
    assert ops(model) == ["Reshape", "Reshape"]
