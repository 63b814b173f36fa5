"""Two nodes in a row that ``eliminate-redundant`` makes one of, or none."""

import numpy as np
import pytest

from me2e_compress.passes.eliminate_redundant import EliminateRedundant
from tests.passes.small import apply, compute, ops, read

HEAD = '<ir_version: 9, opset_import: ["" : 17]>\n'

MERGES: list[tuple[str, str, list[str] | None]] = [
    ("Reshape", "b = Transpose<perm = [1, 0]>(a)  c = Reshape(b, s)", None),
    ("", "b = Transpose<perm = [1, 0]>(a)  c = Transpose<perm = [1, 0]>(b)", []),
    ("", "b = Reshape(a, flat)  c = Reshape(b, s)", []),
    ("", "b = Unsqueeze(a, zero)  c = Squeeze(b, zero)", []),
    ("", "b = Cast<to = 11>(a)  c = Cast<to = 1>(b)", []),
    ("", "b = Neg(a)  c = Neg(b)", []),
    ("", "b = Reshape(a, flat)  k = Relu(b)  c = Reshape(k, s)", None),
]


@pytest.mark.parametrize(("_", "body", "middle"), MERGES)
def test_pairs_are_merged(_: str, body: str, middle: list[str] | None) -> None:
    text = (
        HEAD + f"g (float[2,3] x) => (float[2,3] y) {{ a = Abs(x) {body} y = Neg(c) }}"
    )
    weights = {"s": np.array([2, 3]), "flat": np.array([6]), "zero": np.array([0])}
    used = {name: value for name, value in weights.items() if name in body}
    before, after = read(text, **used), read(text, **used)
    apply(EliminateRedundant(), after)
    if middle is not None:
        assert ops(after) == ["Abs", *middle, "Neg"]
    else:
        assert len(ops(after)) == len(ops(before))
    feeds = {"x": np.random.default_rng(0).normal(size=(2, 3)).astype(np.float32)}
    np.testing.assert_array_equal(compute(after, feeds)[0], compute(before, feeds)[0])


def test_a_cast_that_loses_digits_is_not_skipped() -> None:
    model = read(
        HEAD + "g (float[2,3] x) => (float[2,3] y) { a = Abs(x) b = Cast<to = 10>(a)"
        " c = Cast<to = 1>(b) y = Neg(c) }"
    )
    apply(EliminateRedundant(), model)
    assert ops(model) == ["Abs", "Cast", "Cast", "Neg"]


def test_merged_casts_say_what_happens_beyond_the_range() -> None:
    """To float8, 10000 is NaN where the Cast does not saturate, and else 448."""
    model = read(
        """
        <ir_version: 9, opset_import: ["" : 19]>
        g (float16[1] x) => (float[1] y) {
            a = Cast<to = 1>(x)
            b = Cast<to = 17, saturate = 0>(a)
            y = Cast<to = 1>(b)
        }
        """
    )
    apply(EliminateRedundant(), model)
    assert ops(model) == ["Cast", "Cast"]
    [found] = compute(model, {"x": np.array([10000], np.float16)})
    np.testing.assert_array_equal(found, [np.nan])


@pytest.mark.parametrize(
    ("axis", "start", "end", "left"),
    [
        (0, 0, 2, ["Abs", "Neg"]),
        (0, 2, 3, ["Sqrt", "Neg"]),
        (0, -1, 99, ["Sqrt", "Neg"]),
        (0, 0, 1, ["Abs", "Sqrt", "Concat", "Slice", "Neg"]),
        (0, 1, 3, ["Abs", "Sqrt", "Concat", "Slice", "Neg"]),
        (1, 0, 2, ["Abs", "Sqrt", "Concat", "Slice", "Neg"]),
    ],
)
def test_a_slice_that_takes_one_operand_of_a_concat_reads_it(
    axis: int, start: int, end: int, left: list[str]
) -> None:
    text = (
        '<ir_version: 8, opset_import: ["" : 17]>\n'
        "g (float[2,3] x, float[1,3] z) => (float[M,N] y) { a = Abs(x) b = Sqrt(z)"
        " both = Concat<axis = 0>(a, b) part = Slice(both, s, e, k) y = Neg(part) }"
    )
    bounds = {"s": np.array([start]), "e": np.array([end]), "k": np.array([axis])}
    model, feeds = read(text, **bounds), {"x": np.ones((2, 3), np.float32)}
    feeds["z"] = np.full((1, 3), 4, np.float32)
    (want,) = compute(model, feeds)
    apply(EliminateRedundant(), model)
    assert ops(model) == left
    np.testing.assert_array_equal(compute(model, feeds)[0], want)


def test_slices_of_different_axes_become_one() -> None:
    text = (
        HEAD
        + """
    g (float[4,6] x) => (float[2,3] y) {
        a = Slice(x, one, three, zero)
        y = Slice(a, one, seven, ones, two)
    }
    """
    )
    numbers = {"zero": 0, "one": 1, "three": 3, "seven": 7, "ones": 1, "two": 2}
    weights = {name: np.array([number]) for name, number in numbers.items()}
    before, after = read(text, **weights), read(text, **weights)
    apply(EliminateRedundant(), after)
    assert ops(after) == ["Slice"]
    feeds = {"x": np.arange(24, dtype=np.float32).reshape(4, 6)}
    np.testing.assert_array_equal(compute(after, feeds)[0], compute(before, feeds)[0])


def test_an_expand_before_a_broadcast_goes() -> None:
    text = (
        HEAD
        + """
    g (float[1,3] x, float[5,3] z) => (float[5,3] y) {
        wide = Expand(x, s)
        y = Add(wide, z)
    }
    """
    )
    model = read(text, s=np.array([5, 3]))
    apply(EliminateRedundant(), model)
    assert ops(model) == ["Add"]


def test_concats_of_one_axis_become_one() -> None:
    text = (
        HEAD
        + """
    g (float[2] x, float[2] z) => (float[6] y) {
        a = Concat<axis = 0>(x, z)
        y = Concat<axis = 0>(a, x)
    }
    """
    )
    model = read(text)
    apply(EliminateRedundant(), model)
    assert [value.name for value in model.graph.node(0).inputs if value] == [
        "x",
        "z",
        "x",
    ]
