"""ONNX's small integer and shape arithmetic, computed by ``onnx.reference``.

Only calls whose meaning is certain are answered; onnxruntime computes the others.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import onnx
import onnx_ir as ir
from onnx.reference import ReferenceEvaluator

from me2e_compress.graph.nodes import NATIVE
from me2e_compress.graph.rewrite import Array

MOST_ELEMENTS = 1 << 20
"""Limit of a result, in elements, whatever shape the file claims."""
OLDEST_OPSET = 7
"""Broadcasting followed other rules before this opset."""

OPERATORS = frozenset(
    {
        *("Abs", "Add", "And", "Cast", "Ceil", "Concat", "ConstantOfShape", "Div"),
        *("Equal", "Expand", "Floor", "Gather", "Greater", "GreaterOrEqual"),
        *("Identity", "Less", "LessOrEqual", "Max", "Min", "Mod", "Mul", "Neg"),
        *("NonZero", "Not", "Or", "Range", "ReduceMax", "ReduceMin", "ReduceProd"),
        *("ReduceSum", "Reshape", "Slice", "Sqrt", "Squeeze", "Sub", "Transpose"),
        *("Unsqueeze", "Where"),
    }
)
"""Operators that are exact in integers, and of floats those that round once."""

_REFUSALS = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""What ``onnx.reference`` raises on calls that break ONNX's rules."""


def evaluate(node: ir.Node, inputs: Sequence[Array | None], opset: int) -> Array | None:
    """Compute a node's only output; None where the answer is not certain."""
    if node.op_type not in OPERATORS or opset < OLDEST_OPSET or len(node.outputs) != 1:
        return None
    is_certain = _CHECKS.get(node.op_type)
    # A call that fails is left to onnxruntime
    with np.errstate(all="ignore"):
        try:
            if is_certain is not None and not is_certain(node, inputs):
                return None
            array = _run(node, inputs, opset)
        except _REFUSALS:
            return None
    expected = node.outputs[0].dtype
    if expected is not None and array.dtype != expected.numpy():
        return None
    return array


def _run(node: ir.Node, inputs: Sequence[Array | None], opset: int) -> Array:
    call = ir.serde.serialize_node(node)
    del call.input[:], call.output[:], call.metadata_props[:]
    feeds: dict[str, Any] = {}
    for array in inputs:
        name = "" if array is None else f"in{len(feeds)}"
        call.input.append(name)
        if array is not None:
            feeds[name] = array
    call.output.append("out")
    ports = [onnx.ValueInfoProto(name=name) for name in (*feeds, "out")]
    body = onnx.helper.make_graph([call], "call", ports[:-1], ports[-1:])
    (result,) = ReferenceEvaluator(body, opsets={"": opset}).run(None, feeds)
    return np.asarray(result)


def _divides(node: ir.Node, inputs: Sequence[Any]) -> bool:
    return inputs[0].dtype.kind not in "iu" or bool(np.all(inputs[1]))


def _casts(node: ir.Node, inputs: Sequence[Any]) -> bool:
    source, target = inputs[0], ir.DataType(node.attributes.get_int("to", 0))
    if target not in NATIVE:
        return False
    kind = target.numpy()
    if source.dtype.kind != "f" or kind.kind not in "iu":
        return True
    limits = np.iinfo(kind)
    return bool(np.all((source > limits.min) & (source < limits.max)))


def _counts(node: ir.Node, inputs: Sequence[Any]) -> bool:
    start, limit, delta = inputs
    if start.dtype.kind not in "iu" or not delta.item():
        return False
    return bool((limit.item() - start.item()) / delta.item() <= MOST_ELEMENTS)


def _fills(node: ir.Node, inputs: Sequence[Any]) -> bool:
    """Check the size that the last input of Expand or ConstantOfShape asks for."""
    given = inputs[0].shape if node.op_type == "Expand" else ()
    shape = np.broadcast_shapes(given, tuple(int(size) for size in inputs[-1]))
    return math.prod(shape) <= MOST_ELEMENTS


def _reduces(node: ir.Node, inputs: Sequence[Any]) -> bool:
    return inputs[0].dtype.kind in "iu"


_CHECKS: dict[str, Callable[[ir.Node, Sequence[Any]], bool]] = {
    **dict.fromkeys(("ConstantOfShape", "Expand"), _fills),
    **dict.fromkeys(("Div", "Mod"), _divides),
    **dict.fromkeys(("ReduceMax", "ReduceMin", "ReduceProd", "ReduceSum"), _reduces),
    "Cast": _casts,
    "NonZero": lambda node, inputs: inputs[0].ndim > 0,
    "Range": _counts,
}
