"""Values that ONNX's inference carries along: a bound on how many, before it begins.

It takes every vector for a shape, and a vector of a billion elements takes it minutes
and all memory: thirty Concats, each of the one before twice, make one of a scalar.
"""

import math

import onnx_ir as ir

from me2e_compress.graph.nodes import array_of, input_at, nodes_in

MOST_CARRIED = 1 << 24
"""Elements that are carried along in all: about 3 s."""

_CARRY = frozenset(
    {"Add", "Cast", "Concat", "Gather", "Mul", "Slice", "Squeeze", "Sub", "Unsqueeze"}
)
"""Operators that ONNX follows values through, but for those that read shapes alone."""
_FILL = frozenset({"ConstantOfShape", "Expand", "Range", "Tile"})
"""Operators that make vectors as long as a number says."""


def can_carry(graph: ir.Graph) -> bool:
    """Return whether ONNX can carry the values of a graph along in bounded time."""
    longest: dict[ir.Value, int] = {}
    total = 0
    for node in nodes_in(graph):
        if node.op_type in _FILL:
            size = _filled(node)
        elif node.op_type in _CARRY and node.attributes.get_int("axis", 0) in (0, -1):
            read = [longest.get(each, _length(each)) for each in node.inputs if each]
            size = sum(read) if node.op_type == "Concat" else max(read, default=0)
            total += size
        else:
            continue
        made = node.outputs[0]
        if made.shape is None or len(made.shape) < 2:
            longest[made] = max(size, _length(made))
    return total <= MOST_CARRIED


def _length(value: ir.Value) -> int:
    """Return the elements of a vector; 1 where nothing says what it is."""
    if value.shape is None or not len(value.shape):
        return 1
    size = value.shape[0] if len(value.shape) == 1 else 0
    return size if isinstance(size, int) else 1


def _filled(node: ir.Node) -> int:
    """Return how many elements constants ask for, at most; 0 where none does."""
    arrays = [array_of(input_at(node, at)) for at in range(len(node.inputs))]
    counts = [each for each in arrays if each is not None and each.dtype.kind == "i"]
    return math.prod(int(each.max(initial=1)) for each in counts if each.size < 64)
