"""A Range of constants, by numpy where that is ONNX's meaning, else by the runtime."""

from typing import Any

import numpy as np
import pytest

from me2e_compress.passes.fold_constants import FoldConstants
from tests.passes.small import apply, compute, ops, read


def graph_with(start: Any, limit: Any, delta: Any, kind: str = "int64") -> Any:
    text = f"""
    <ir_version: 9, opset_import: ["" : 17]>
    g ({kind}[1] x) => ({kind}[N] y) {{ r = Range(a, b, c) y = Add(x, r) }}
    """
    return read(text, a=start, b=limit, c=delta)


@pytest.mark.parametrize(
    ("start", "limit", "delta", "expected"),
    [(0, 5, 2, [0, 2, 4]), (5, 0, -2, [5, 3, 1]), (3, 3, 1, []), (0, 3, -1, [])],
)
def test_a_range_of_integers(
    start: int, limit: int, delta: int, expected: list[int]
) -> None:
    model = graph_with(np.int64(start), np.int64(limit), np.int64(delta))

    apply(FoldConstants(bytes_per_node=10**6), model)

    assert ops(model) == ["Add"]
    assert compute(model, {"x": np.zeros(1, np.int64)})[0].tolist() == expected


def test_a_range_of_floats_is_that_of_the_runtime_to_the_bit() -> None:
    ends = np.float32(0), np.float32(100), np.float32(0.1)
    before, after = graph_with(*ends, "float"), graph_with(*ends, "float")

    apply(FoldConstants(bytes_per_node=10**6), after)

    feeds = {"x": np.zeros(1, np.float32)}
    assert ops(after) == ["Add"]
    np.testing.assert_array_equal(compute(after, feeds)[0], compute(before, feeds)[0])


def test_a_range_that_never_ends_stays_for_the_runtime_to_refuse() -> None:
    model = graph_with(np.int64(0), np.int64(5), np.int64(0))

    assert apply(FoldConstants(), model).changes == 0
