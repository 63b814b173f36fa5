"""Constants beside products, in chains and in comparisons.

Given:   MatMul(x, weight) + bias, x of rank 2;  (x * c) * d;  x [6, 10000, 1] > 0.5;
         Greater(ReduceSum(Cast(conditions) to int64), 0)

Result:  Gemm;  x * (c d);  0.5 of shape [1, 1, 1];
         Greater(ReduceSum(Cast(conditions) to float), 0)

At rank 3 MatMul + Add stays: Reshape, Gemm, Reshape would hide the product from
attention patterns and misplace the quantizers.
"""

import itertools
import math

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import array_of, provenance, static_shape
from me2e_compress.graph.nodes import ELEMENTWISE, FLOATS, Array
from me2e_compress.graph.rewrite import Facts, Fusion, Kit, Match, constant, op, var

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


SOURCE = var("source", computed=True)
FIRST, SECOND = constant(), constant()


def _chain(match: Match, kit: Kit) -> str | None:
    """Multiply (or add) two consecutive constants in advance."""
    first, second = match.numbers(FIRST), match.numbers(SECOND)
    op_type, output = match.root.op_type, match.root.outputs[0]
    # Combine in float64, unless digits would be lost
    together = second * first if op_type == "Mul" else second + first
    if op_type == "Add" and np.any(np.abs(first) > CANCELLATION * np.abs(together)):
        return "constants that cancel when added up"
    size = np.abs(together[together != 0])
    limits = None if output.dtype is None else np.finfo(output.dtype.numpy())
    if limits is None or not np.all((size <= limits.max) & (size >= limits.tiny)):
        return "constants that overflow when multiplied"
    if together.size > max(first.size, second.size):
        return "constants that grow when combined"
    array = together.astype(limits.dtype)
    value = kit.constant(array, f"{output.name}_{op_type.lower()}")
    kit.put(op_type, [match[SOURCE], value])
    return None


# Whether any condition is true: torch writes ``count_nonzero(x) > 0`` in this form. A
# sum of ones is above 0 in either type, and onnxruntime's CPU (1.31) adds 2.56 million
# float32 in 0.2 ms, int64 in 5.

CONDITIONS = var("conditions")
ZERO = constant(floating=False, scalar=True)
SUM = op("ReduceSum", op("Cast", CONDITIONS), more=True)
ANY_OF = op("Greater", SUM, ZERO)


def _counts(match: Match, facts: Facts) -> bool:
    zero = match.array(ZERO)
    integers = zero.dtype.kind in "iu" and not zero.any()
    return integers and match[CONDITIONS].dtype == ir.DataType.BOOL


def _add_in_float(match: Match, kit: Kit) -> None:
    total, zero = match.node(SUM), match.array(ZERO)
    real = kit.add("Cast", [match[CONDITIONS]], {"to": int(ir.DataType.FLOAT)})
    options = {name: attr.value for name, attr in total.attributes.items()}
    added = kit.add("ReduceSum", [real, *total.inputs[1:]], options)
    name = f"{match[ZERO].name}_float"
    kit.put("Greater", [added, kit.constant(zero.astype(np.float32), name)])


# A constant of one number gets the rank of the other operand if the last axes of that
# have size 1; the result is the same. onnxruntime's CPU (1.31) merges axes of size 1
# only if both operands have them, and computes one element at a time otherwise: a
# comparison of 240,000 elements takes 1.39 ms, not 0.03.

LEAST = 1000
"""Elements that take onnxruntime 6 us one at a time: three starts of a node."""


def _slow_scalar(node: ir.Node) -> tuple[int, Array] | None:
    """Return the index of a constant of one number, and that with the other's rank."""
    for index in (0, 1):
        array = array_of(node.inputs[index])
        shape = static_shape(node.inputs[1 - index])
        if array is None or array.size != 1 or shape is None:
            continue
        ones = sum(1 for _ in itertools.takewhile(lambda n: n == 1, reversed(shape)))
        if ones and array.ndim <= ones and math.prod(shape) >= LEAST:
            return index, array.reshape((1,) * len(shape))
    return None


def _give_axes(match: Match, kit: Kit) -> None:
    node, slow = match.root, _slow_scalar(match.root)
    assert slow is not None
    kit.refill(node, *slow, f"{node.outputs[0].name}_scalar")
    provenance.inherit(node, (node,), by=kit.by)


GEMM = Fusion(
    "MatMul + bias",
    PLUS,
    lambda match, kit: kit.put("Gemm", [match[LEFT], match[RIGHT], match[OFFSET]]),
    where=_is_of_matrices,
)
FUSIONS = (
    *(
        Fusion("constant chains", op(kind, op(kind, SOURCE, FIRST), SECOND), _chain)
        for kind in ("Add", "Mul")
    ),
    Fusion("sums of conditions", ANY_OF, _add_in_float, where=_counts),
    Fusion(
        "axes of constants",
        op(ELEMENTWISE, var("left"), var("right")),
        _give_axes,
        where=lambda match, facts: _slow_scalar(match.root) is not None,
    ),
)
