"""What nodes write in a frame: the bytes of activations as they lie in memory."""

import math
from collections.abc import Iterable

import onnx_ir as ir

from me2e_compress.graph.nodes import VIEWS
from me2e_compress.graph.shapes import static_shape

_WRITE_NOTHING = VIEWS | {"Constant", "DequantizeLinear"}
"""They hand on what lies there, or are part of what reads them."""


def value_bytes(value: ir.Value) -> int | None:
    """Return the bytes of a value; None where its shape or type is open, or of text."""
    if value.const_value is not None:
        return int(value.const_value.nbytes)
    shape = static_shape(value)
    if shape is None or value.dtype in (None, ir.DataType.STRING):
        return None
    return math.ceil(math.prod(shape) * value.dtype.itemsize)


def total_bytes(values: Iterable[ir.Value]) -> int | None:
    """Return the bytes of values; None where a shape or type is open."""
    sizes = [value_bytes(value) for value in values]
    known = [size for size in sizes if size is not None]
    return sum(known) if len(known) == len(sizes) else None


def as_written(value: ir.Value) -> ir.Value:
    """Return what lies in memory of what a node gives.

    That are the integers, where nothing but a QuantizeLinear reads it: runtimes do both
    at once.
    """
    readers = [use.node for use in value.uses()]
    if readers and all(each.op_type == "QuantizeLinear" for each in readers):
        return readers[0].outputs[0]
    return value


def activation_bytes(node: ir.Node) -> int | None:
    """Return the bytes that a node writes in a frame.

    Reshapes and the like write none; nor does a DequantizeLinear, and a QuantizeLinear
    only where the maker of what it reads wrote floats.

    Returns:
        None where the shape of something is open.
    """
    if node.op_type in _WRITE_NOTHING or _is_written_before(node):
        return 0
    return total_bytes(as_written(value) for value in node.outputs if value.name)


def _is_written_before(node: ir.Node) -> bool:
    if node.op_type != "QuantizeLinear" or node.inputs[0] is None:
        return False
    maker = node.inputs[0].producer()
    if maker is None or maker.op_type in _WRITE_NOTHING:
        return False
    return as_written(node.inputs[0]) is node.outputs[0]
