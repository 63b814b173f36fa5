"""Fuse matrix products with constants, and chains of constants.

Given:   MatMul(x, weight) + bias, x of rank 2;  (x * c) * d

Result:  Gemm;  x * (c d)

At rank 3 MatMul + Add stays: Reshape, Gemm, Reshape would hide the product from
attention patterns and misplace the quantizers.
"""

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import static_shape
from me2e_compress.graph.rewrite import (
    FLOATS,
    Facts,
    Fusion,
    Kit,
    Match,
    Numbers,
    constant,
    op,
    var,
)

CANCELLATION = 1e3
"""Constants that cancel more than three decimal digits are not added in advance."""

LEFT, RIGHT, OFFSET = var("left"), var("right"), constant(floating=False)
INNER = op("MatMul", LEFT, RIGHT)
PLUS = op("Add", INNER, OFFSET)


def _is_of_matrices(match: Match, facts: Facts) -> bool:
    """Return whether the product has rank 2 and the offset varies only by column."""
    inner = match.node(INNER)
    if facts.opset < 7 or match.root.outputs[0].dtype not in FLOATS:
        return False
    left, right, out = map(static_shape, (*inner.inputs, *inner.outputs))
    if left is None or right is None or out is None:
        return False
    columns = out[-1:]
    added = match.array(OFFSET).shape
    return len(left) == len(right) == 2 and added in ((), (1,), columns, (1, *columns))


def _gemm(match: Match, kit: Kit) -> None:
    kit.put("Gemm", [match[LEFT], match[RIGHT], match[OFFSET]])


SOURCE = var("source", computed=True)
FIRST, SECOND = constant(), constant()
CHAINS = {
    op_type: op(op_type, op(op_type, SOURCE, FIRST), SECOND)
    for op_type in ("Add", "Mul")
}


def _chain(match: Match, kit: Kit) -> str | None:
    """Multiply (or add) two consecutive constants in advance."""
    first, second = match.numbers(FIRST), match.numbers(SECOND)
    op_type, output = match.root.op_type, match.root.outputs[0]
    # Combine in float64, unless digits would be lost
    if op_type == "Mul":
        together = second * first
    else:
        together = second + first
        if np.any(np.abs(first) > CANCELLATION * np.abs(together)):
            return "constants that cancel when added up"
    if output.dtype is None or not _fits(together, output.dtype):
        return "constants that overflow when multiplied"
    if together.size > max(first.size, second.size):
        return "constants that grow when combined"
    array = together.astype(output.dtype.numpy())
    value = kit.constant(array, f"{output.name}_{op_type.lower()}")
    kit.put(op_type, [match[SOURCE], value])
    return None


def _fits(numbers: Numbers, kind: ir.DataType) -> bool:
    """Return whether numbers neither overflow nor lose digits in a type."""
    limits = np.finfo(kind.numpy())
    size = np.abs(numbers[numbers != 0])
    return bool(np.all((size <= limits.max) & (size >= limits.tiny)))


GEMM = Fusion("MatMul + bias", PLUS, _gemm, where=_is_of_matrices)
CHAIN = tuple(Fusion("constant chains", pattern, _chain) for pattern in CHAINS.values())
