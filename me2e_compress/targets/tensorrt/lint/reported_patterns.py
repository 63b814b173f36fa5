"""The pieces of graph of which users report something; see ``reported.py``.

Each function says of a node, and of the graph's opset, whether it is such a piece.
"""

from collections.abc import Collection

import onnx_ir as ir

from me2e_compress.graph import array_of, input_at, rank_of, static_shape
from me2e_compress.graph.nodes import LAYOUT_OPERATORS, is_standard, maker, scalar_of
from me2e_compress.targets.quantized import is_dequantized

_MOVES = LAYOUT_OPERATORS | {"Cast", "Concat", "Expand", "Gather", "Slice", "Split"}
"""Operators between samples, or weights, and their product."""
_SCORES = LAYOUT_OPERATORS | {"Add", "Cast", "Div", "Mul", "Sub", "Where"}
"""Operators between the first product of an attention and its Softmax."""
_HALVES = (ir.DataType.FLOAT16, ir.DataType.BFLOAT16)
LARGEST_FLOAT16 = 65_504
LONG_AXIS = 1_000
"""Elements of a strided Softmax: those reported had 7,200; below 1,000 it is small."""
HIGH_RANK = 5


def new_words_for_modes(node: ir.Node, opset: int) -> bool:
    """Find a GridSample whose mode has its name of opset 20; left out it is read."""
    return node.attributes.get_string("mode", "") in ("linear", "cubic")


def decomposed_attention(node: ir.Node, opset: int) -> bool:
    """Find the product of samples and attention weights, where they are summed."""
    sides = [value for value in node.inputs if value is not None]
    for one, other in ((0, 1), (1, 0)):
        if len(sides) != 2 or not _comes_of(sides[one], "GridSample", _MOVES):
            continue
        if _comes_of(sides[other], "Softmax", _MOVES):
            return node.op_type != "Mul" or _is_summed(node.outputs[0])
    return False


def float32_island(node: ir.Node, opset: int) -> bool:
    """Find a GridSample in float32 of what was float16, or becomes it."""
    if node.inputs[0] is None or node.inputs[0].dtype != ir.DataType.FLOAT:
        return False
    before = [_source(each) for each in node.inputs]
    after = [each for value in node.outputs for each in value.consumers()]
    casts = [each for each in (*before, *after) if each is not None]
    return any(
        value is not None and value.dtype in _HALVES
        for each in casts
        if each.op_type == "Cast" and is_standard(each)
        for value in (each.inputs[0], each.outputs[0])
    )


def _source(value: ir.Value | None) -> ir.Node | None:
    """Return the node whose elements a value has, in another layout."""
    while (node := maker(value, *LAYOUT_OPERATORS)) is not None:
        value = node.inputs[0]
    return None if value is None else value.producer()


def clipped_product(node: ir.Node, opset: int) -> bool:
    """Find a Clip from 0 to a number of a product with its bias."""
    least, most = _bound(node, "min", 1), _bound(node, "max", 2)
    added = maker(node.inputs[0], "Add")
    if least != 0.0 or most is None or added is None:
        return False
    return any(maker(value, "MatMul") for value in added.inputs)


def _bound(node: ir.Node, name: str, index: int) -> float | None:
    """Return a bound of a Clip: an input, before opset 11 an attribute."""
    value = input_at(node, index)
    if value is not None:
        return scalar_of(value)
    return node.attributes.get_float(name) if name in node.attributes else None


def half_attention(node: ir.Node, opset: int) -> bool:
    """Find the second product of an attention in float16 or bfloat16."""
    softmax = maker(node.inputs[0], "Softmax")
    if softmax is None or softmax.outputs[0].dtype not in _HALVES:
        return False
    return _comes_of(softmax.inputs[0], "MatMul", _SCORES)


def more_keys_than_float16(node: ir.Node, opset: int) -> bool:
    """Find a Softmax in float16 over more elements than float16 can count."""
    extent = _extent(node)[0]
    return node.outputs[0].dtype == ir.DataType.FLOAT16 and extent > LARGEST_FLOAT16


def strided_softmax(node: ir.Node, opset: int) -> bool:
    """Find a Softmax over a long axis that is not the last one."""
    extent, behind = _extent(node)
    return opset >= 13 and extent >= LONG_AXIS and behind > 0


def _extent(node: ir.Node) -> tuple[int, int]:
    """Return the extent of a Softmax's axis, 0 if not known, and the axes behind it."""
    shape = static_shape(node.inputs[0])
    if not shape:
        return 0, 0
    axis = node.attributes.get_int("axis", -1) % len(shape)
    return shape[axis], len(shape) - 1 - axis


def half_squares(node: ir.Node, opset: int) -> bool:
    """Find the variance of a normalization in float16, by its single operators."""
    if node.outputs[0].dtype != ir.DataType.FLOAT16:
        return False
    square = maker(node.inputs[0], "Pow", "Mul")
    if square is None:
        return False
    if square.op_type == "Mul":
        return square.inputs[0] is square.inputs[1]
    exponent = array_of(square.inputs[1])  # of any type
    return exponent is not None and exponent.size == 1 and exponent.item() == 2


def broadcast_product(node: ir.Node, opset: int) -> bool:
    """Find a MatMul of five axes or more that repeats both operands."""
    shapes = [static_shape(value) for value in node.inputs]
    if None in shapes or (rank_of(node.outputs[0]) or 0) < HIGH_RANK:
        return False
    left, right = ((each or ())[:-2] for each in shapes)
    # align the batches at their end, as broadcasting does
    pairs = list(zip(reversed(left), reversed(right), strict=False))
    grows = [any(a < b for a, b in pairs) or len(left) < len(right)]
    grows += [any(b < a for a, b in pairs) or len(right) < len(left)]
    return all(grows)


def int8_product(node: ir.Node, opset: int) -> bool:
    """Find a product, not a convolution, of two int8 operands."""
    return all(map(is_dequantized, node.inputs[:2]))


def bfloat16_deconvolution(node: ir.Node, opset: int) -> bool:
    """Find a ConvTranspose in bfloat16."""
    return node.inputs[0] is not None and node.inputs[0].dtype == ir.DataType.BFLOAT16


def conditional_resize(node: ir.Node, opset: int) -> bool:
    """Find a Resize of the Transpose of what an If gives."""
    moved = maker(node.inputs[0], "Transpose")
    return moved is not None and maker(moved.inputs[0], "If") is not None


def plugin(node: ir.Node, opset: int) -> bool:
    """Take every node of the plugins that a row names, whatever their domain."""
    return True


def _comes_of(value: ir.Value | None, op_type: str, through: Collection[str]) -> bool:
    """Return whether some operators, at most, lie between a value and its source."""
    waiting, seen = [value], set[ir.Node]()
    while waiting:
        found = waiting.pop()
        node = None if found is None else found.producer()
        if node is None or node in seen or not is_standard(node):
            continue
        if node.op_type == op_type:
            return True
        seen.add(node)
        if node.op_type in through:
            waiting.extend(v for v in node.inputs if array_of(v) is None)
    return False


def _is_summed(value: ir.Value) -> bool:
    """Return whether a ReduceSum reads a value, perhaps in another layout."""
    waiting, seen = [value], set[ir.Node]()
    while waiting:
        for node in waiting.pop().consumers():
            if node.op_type == "ReduceSum":
                return True
            if node.op_type in LAYOUT_OPERATORS and node not in seen:
                seen.add(node)
                waiting.extend(node.outputs)
    return False
