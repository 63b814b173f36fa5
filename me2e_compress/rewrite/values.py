"""What a value is: who makes it, who reads it, and the number it holds."""

from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.graph import array_of, is_standard

Array: TypeAlias = npt.NDArray[np.generic]
Numbers: TypeAlias = npt.NDArray[np.float64]

FLOATS = frozenset({ir.DataType.DOUBLE, ir.DataType.FLOAT, ir.DataType.FLOAT16})
"""The floating-point types that numpy itself computes with."""

CLOSE = 1e-4
"""How near a constant must be to the textbook's, relative: 0.7071 is 1/sqrt 2."""


def maker(value: ir.Value | None, *op_types: str) -> ir.Node | None:
    """Return the node that makes a value, if it is one of these standard operators."""
    node = None if value is None else value.producer()
    if node is None or not is_standard(node) or node.op_type not in op_types:
        return None
    return node


def sole_maker(value: ir.Value | None, *op_types: str) -> ir.Node | None:
    """Return the maker of a value that one node reads, of the same graph."""
    node = maker(value, *op_types)
    if node is None or value is None or sole_reader(value) is None:
        return None
    return node if value is node.outputs[0] else None


def sole_reader(value: ir.Value) -> ir.Node | None:
    """Return the one node that reads a value, once; None if others do, or outputs.

    None too if it is in another graph than the value's maker, in the body of an If or
    Loop: that runs seldom, or often, and what it makes stays inside.
    """
    uses = value.uses()
    if len(uses) != 1 or value.is_graph_output():
        return None
    node, made = next(iter(uses)).node, value.producer()
    return node if made is None or made.graph is node.graph else None


def is_read(value: ir.Value) -> bool:
    """Return whether anything needs a value: a node, or the outside."""
    return bool(value.uses()) or value.is_graph_output()


def holds_numbers(value: ir.Value | None) -> bool:
    """Return whether a value is a constant of a floating-point type."""
    return value is not None and value.dtype in FLOATS and array_of(value) is not None


def numbers_of(value: ir.Value | None) -> Numbers | None:
    """Return a constant floating-point array, widened to float64."""
    array = array_of(value) if holds_numbers(value) else None
    return None if array is None else array.astype(np.float64)


def scalar_of(value: ir.Value | None) -> float | None:
    """Return a constant of one element; None if it is an array or computed."""
    array = array_of(value) if holds_numbers(value) else None
    return float(array.item()) if array is not None and array.size == 1 else None


def overflow(numbers: Numbers, stored: Array) -> bool:
    """Return whether numbers are too large for the type of a stored array."""
    limit = np.finfo(stored.dtype.name).max
    return not np.all(np.abs(numbers) <= limit)


def is_close(value: float | None, expected: float) -> bool:
    """Return whether a constant is the textbook's, within :data:`CLOSE`."""
    return value is not None and abs(value - expected) <= CLOSE * abs(expected)
