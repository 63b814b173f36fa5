"""ONNX's small integer and shape arithmetic in numpy.

Each rule takes a call (the node, its inputs as arrays, the opset) and returns the
first output, or None where ONNX's meaning is not certain; onnxruntime computes it then.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import onnx_ir as ir

from me2e_compress.rewrite import Array

NATIVE = frozenset(
    {
        *(ir.DataType.BOOL, ir.DataType.DOUBLE, ir.DataType.FLOAT, ir.DataType.FLOAT16),
        *(ir.DataType.INT8, ir.DataType.INT16, ir.DataType.INT32, ir.DataType.INT64),
        *(ir.DataType.UINT8, ir.DataType.UINT16),
        *(ir.DataType.UINT32, ir.DataType.UINT64),
    }
)
"""The element types that numpy itself computes with."""

MOST_ELEMENTS = 1 << 20
"""Limit of a rule's result, in elements, whatever shape the file claims."""
OLDEST_OPSET = 7
"""Broadcasting followed other rules before this opset."""


@dataclasses.dataclass(frozen=True)
class Call:
    """One node with known inputs."""

    node: ir.Node
    inputs: Sequence[Array | None]
    opset: int

    def array(self, index: int) -> Any:
        """Return an input; None where it is omitted."""
        return self.inputs[index] if index < len(self.inputs) else None

    def ints(self, name: str, index: int | None = None) -> list[int] | None:
        """Read a list that newer opsets moved from an attribute to an input."""
        given = self.array(index) if index is not None else None
        if given is not None:
            return [int(entry) for entry in given.reshape(-1)]
        return self._attribute(name)

    def integer(self, name: str, default: int) -> int:
        """Read an integer attribute."""
        return self.node.attributes.get_int(name, default)

    def _attribute(self, name: str) -> list[int] | None:
        found = self.node.attributes.get(name)
        return None if found is None else [int(entry) for entry in found.as_ints()]


Rule = Callable[[Call], Any]


def evaluate(node: ir.Node, inputs: Sequence[Array | None], opset: int) -> Array | None:
    """Compute a node's only output; None where the table has no certain answer."""
    rule = RULES.get(node.op_type)
    if rule is None or opset < OLDEST_OPSET or len(node.outputs) != 1:
        return None
    expected = node.outputs[0].dtype
    # A rule that fails leaves the answer to onnxruntime
    with np.errstate(all="ignore"):
        try:
            result = rule(Call(node, inputs, opset))
        except (IndexError, ValueError, TypeError, OverflowError):
            return None
    if result is None:
        return None
    array = np.asarray(result)
    if expected is not None and array.dtype != expected.numpy():
        return None
    return array


def _binary(function: Callable[[Any, Any], Any]) -> Rule:
    return lambda call: function(call.array(0), call.array(1))


def _unary(function: Callable[[Any], Any]) -> Rule:
    return lambda call: function(call.array(0))


def _variadic(function: Callable[[Any, Any], Any]) -> Rule:
    def fold(call: Call) -> Any:
        result = call.array(0)
        for index in range(1, len(call.inputs)):
            result = function(result, call.array(index))
        return result

    return fold


def _div(call: Call) -> Any:
    left, right = call.array(0), call.array(1)
    if left.dtype.kind not in "iu":
        return left / right
    if not np.all(right):
        return None
    quotient = np.abs(left) // np.abs(right)
    return (quotient * np.sign(left) * np.sign(right)).astype(left.dtype)


def _mod(call: Call) -> Any:
    left, right = call.array(0), call.array(1)
    if left.dtype.kind in "iu" and not np.all(right):
        return None
    return (np.fmod if call.integer("fmod", 0) else np.mod)(left, right)


def _cast(call: Call) -> Any:
    target = ir.DataType(call.integer("to", 0))
    source = call.array(0)
    if target not in NATIVE:
        return None
    kind = target.numpy()
    if source.dtype.kind == "f" and kind.kind in "iu":
        limits = np.iinfo(kind)
        if not np.all((source > limits.min) & (source < limits.max)):
            return None
    return source.astype(kind)


def _gather(call: Call) -> Any:
    return np.take(call.array(0), call.array(1), axis=call.integer("axis", 0))


def _squeeze(call: Call) -> Any:
    axes = call.ints("axes", 1)
    return np.squeeze(call.array(0), None if axes is None else tuple(axes))


def _unsqueeze(call: Call) -> Any:
    return np.expand_dims(call.array(0), tuple(call.ints("axes", 1) or ()))


def _slice(call: Call) -> Any:
    data = call.array(0)
    starts, ends = call.ints("starts", 1), call.ints("ends", 2)
    if starts is None or ends is None:
        return None
    axes = call.ints("axes", 3) or list(range(len(starts)))
    steps = call.ints("steps", 4) or [1] * len(starts)
    # Build one slice per axis; a negative step may run past the front
    window = [slice(None)] * data.ndim
    for axis, start, end, step in zip(axes, starts, ends, steps, strict=True):
        size = data.shape[axis]
        stop: int | None = end
        if step < 0 and end < -size:
            stop = None
        window[axis] = slice(start, stop, step)
    return data[tuple(window)]


def _reshape(call: Call) -> Any:
    data, wanted = call.array(0), call.ints("shape", 1)
    if wanted is None:
        return None
    if not call.integer("allowzero", 0):
        wanted = [
            data.shape[axis] if size == 0 else size for axis, size in enumerate(wanted)
        ]
    return data.reshape(wanted)


def _concat(call: Call) -> Any:
    parts = [part for part in call.inputs if part is not None]
    return np.concatenate(parts, axis=call.integer("axis", 0))


def _range(call: Call) -> Any:
    start, limit, delta = call.array(0), call.array(1), call.array(2)
    if start.dtype.kind not in "iu" or not delta.item():
        return None
    if (limit.item() - start.item()) / delta.item() > MOST_ELEMENTS:
        return None
    return np.arange(start.item(), limit.item(), delta.item(), dtype=start.dtype)


def _constant_of_shape(call: Call) -> Any:
    given = call.node.attributes.get("value")
    fill = np.zeros(1, np.float32) if given is None else given.as_tensor().numpy()
    shape = [int(size) for size in call.array(0).reshape(-1)]
    if math.prod(shape) > MOST_ELEMENTS:
        return None
    return np.full(shape, fill.reshape(-1)[0], dtype=fill.dtype)


def _expand(call: Call) -> Any:
    shape = np.broadcast_shapes(
        call.array(0).shape, tuple(int(size) for size in call.array(1))
    )
    return np.broadcast_to(call.array(0), shape)


def _transpose(call: Call) -> Any:
    return np.transpose(call.array(0), call.ints("perm"))


def _reduce(function: Callable[..., Any]) -> Rule:
    def fold(call: Call) -> Any:
        data, axes = call.array(0), call.ints("axes", 1)
        if data.dtype.kind not in "iu":
            return None
        if not axes and call.integer("noop_with_empty_axes", 0):
            return data
        keep = bool(call.integer("keepdims", 1))
        chosen = tuple(axes) if axes else None
        return function(data, axis=chosen, keepdims=keep).astype(data.dtype)

    return fold


def _non_zero(call: Call) -> Any:
    data = call.array(0)
    return np.array(np.nonzero(data), dtype=np.int64) if data.ndim else None


RULES: dict[str, Rule] = {
    "Abs": _unary(np.abs),
    "Add": _binary(np.add),
    "And": _binary(np.logical_and),
    "Cast": _cast,
    "Ceil": _unary(np.ceil),
    "Concat": _concat,
    "ConstantOfShape": _constant_of_shape,
    "Div": _div,
    "Equal": _binary(np.equal),
    "Expand": _expand,
    "Floor": _unary(np.floor),
    "Gather": _gather,
    "Greater": _binary(np.greater),
    "GreaterOrEqual": _binary(np.greater_equal),
    "Identity": _unary(lambda data: data),
    "Less": _binary(np.less),
    "LessOrEqual": _binary(np.less_equal),
    "Max": _variadic(np.maximum),
    "Min": _variadic(np.minimum),
    "Mod": _mod,
    "Mul": _binary(np.multiply),
    "Neg": _unary(np.negative),
    "NonZero": _non_zero,
    "Not": _unary(np.logical_not),
    "Or": _binary(np.logical_or),
    "Range": _range,
    "ReduceMax": _reduce(np.max),
    "ReduceMin": _reduce(np.min),
    "ReduceProd": _reduce(np.prod),
    "ReduceSum": _reduce(np.sum),
    "Reshape": _reshape,
    "Slice": _slice,
    "Sqrt": _unary(np.sqrt),
    "Squeeze": _squeeze,
    "Sub": _binary(np.subtract),
    "Transpose": _transpose,
    "Unsqueeze": _unsqueeze,
    "Where": lambda call: np.where(call.array(0), call.array(1), call.array(2)),
}
