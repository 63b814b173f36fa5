"""Compute nodes once for all that a repetition repeats, and repeat their result.

Given:   Reshape(Tile(x)) -> MatMul(W) -> Add(points);  Reshape(Tile(x)) -> Softmax

Result:  Reshape(x) -> MatMul(W) -> Add(points), which repeats by itself;
         Reshape(x) -> Softmax -> Expand

A row-wise operator f maps every row alone: with R, which repeats rows,

    f(R(x))        =  R(f(x))                 a layer x W, a Softmax, a Relu
    f(R(x), y)     =  f(x, y)                 an Add repeats the smaller operand itself
    f(R(x), R(y))  =  R(f(x, y))              a Concat, too

Spatial cross attention repeats its queries for every camera (Li et al., BEVFormer,
2022, section 3.3): sampling offsets and weights are the same for all of them.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import array_of, is_standard, macs, rank_of, static_shape
from me2e_compress.graph.nodes import (
    Array,
    holds_numbers,
    is_read,
    permutation_of,
    sole_reader,
)
from me2e_compress.operators import FusedCall
from me2e_compress.passes.digits import (
    Digit,
    Digits,
    Layout,
    before,
    flat,
    merged,
    regrouped,
    split_like,
    whole,
)
from me2e_compress.passes.hoist_linear.sums import is_product, replace
from me2e_compress.passes.work import (
    MACS_PER_NODE,
    MOVED_BYTES_PER_NODE,
    item_bytes,
    work,
)

# The axes along which a value repeats, behind whatever regroups them: a Reshape of
# Tile(x, [1, 6, 1, 1]) to [6, cells, heads, 32] repeats along its first axis, and so
# does every layer's output that is made of it row by row. What counts are the digits of
# the indices (:mod:`me2e_compress.passes.digits`): those that a Tile, Expand or Concat
# adds make no difference to what the value holds.

# Operators that may repeat axes.
REPEATS = frozenset({"Concat", "Expand", "Tile"})
# Largest number of nodes between the source and the repeated value.
LONGEST = 16


@dataclasses.dataclass(frozen=True)
class RepeatedAxes:
    """A value that is ``Expand(Reshape(source, small), large)``, reshaped."""

    source: ir.Value  # holds every element once
    small: tuple[int, ...]  # the sizes of ``large``, and 1 where the value repeats
    large: tuple[int, ...]  # its shape; axes that repeat in part are split
    nodes: tuple[ir.Node, ...]  # between both, the last one first


def repeated_axes(value: ir.Value) -> RepeatedAxes | None:
    """Return the smallest source of a value that repeats; None if it does not.

    Of several sources of one size it is the last.
    """
    shape = static_shape(value)
    if not shape or 0 in shape:
        return None
    # Every axis of the value is an index of its own
    layout: Layout = tuple(whole(str(axis), size) for axis, size in enumerate(shape))
    # Go back as far as digits can be followed; remember where the fewest elements are
    best, least = None, math.prod(shape)
    nodes: list[ir.Node] = []
    while len(nodes) < LONGEST:
        node = value.producer()
        if node is None or node.graph is not value.graph:
            break
        source = node.inputs[0] if node.inputs else None
        earlier = _before_repeats(node, layout)
        if earlier is None or source is None:
            break
        value, layout = source, earlier
        nodes.append(node)
        size = math.prod(static_shape(value) or ())
        sizes = _sizes(shape, merged(flat(layout))) if size < least else None
        if sizes is not None:
            best, least = RepeatedAxes(value, *sizes, tuple(nodes)), size
    return best


def _before_repeats(node: ir.Node, layout: Layout) -> Layout | None:
    """Return the layout of what a node moves or repeats; None if it does neither."""
    if not is_standard(node) or not node.inputs:
        return None
    small = static_shape(node.inputs[0])
    if small is None or node.op_type not in REPEATS:
        return before(node, layout)
    if node.op_type == "Concat" and len(set(node.inputs)) != 1:
        return None
    # The digits of an axis before it was repeated are its last ones
    once: list[Digits] = []
    for digits, size in zip(layout[len(layout) - len(small) :], small, strict=True):
        times = math.prod(digit.size for digit in digits) // size
        split = regrouped((digits,), (times, size))
        if split is None:
            return None
        once.append(split[1])
    return tuple(once)


def _sizes(
    shape: Sequence[int], source_digits: Digits
) -> tuple[tuple[int, ...], tuple[int, ...]] | None:
    """Return the small and the large sizes; None if the source has another order."""
    small, large, mine = list[int](), list[int](), list[Digit]()

    def is_kept(one: Digit) -> bool:
        same = (other for other in source_digits if other.axis == one.axis)
        return any(o.stride <= one.stride and one.end <= o.end for o in same)

    # Cut each axis into digits that the source has and digits that it repeats over
    for axis, size in enumerate(shape):
        pieces = split_like(whole(str(axis), size), source_digits)
        if not pieces:
            small.append(1)
            large.append(1)
        for stays, group in itertools.groupby(pieces, is_kept):
            digits = list(group)
            large.append(math.prod(digit.size for digit in digits))
            small.append(large[-1] if stays else 1)
            mine.extend(digits if stays else ())
    return (tuple(small), tuple(large)) if merged(mine) == source_digits else None


# Operators that compute every element, or every row of the last axis, by itself.


# Operators that map every element by itself.
UNARY = frozenset(
    {
        "Abs", "Celu", "Clip", "Cos", "Elu", "Erf", "Exp", "Gelu", "HardSigmoid",
        "HardSwish", "Identity", "LeakyRelu", "Log", "Mish", "Neg", "Reciprocal",
        "Relu", "Selu", "Sigmoid", "Sin", "Softplus", "Softsign", "Sqrt", "Tanh",
    }
)  # fmt: skip

# Element-wise operators of two operands, which broadcast.
BINARY = frozenset({"Add", "Div", "Max", "Min", "Mul", "Pow", "Sub"})

# Operators that map every row by itself where their axis is the last.
ALONG_AXIS = frozenset({"LayerNormalization", "LogSoftmax", "Softmax"})


def is_row_wise(node: ir.Node) -> bool:
    """Return whether a node maps every element, or every row of the last axis."""
    if not is_standard(node) or any(map(is_read, node.outputs[1:])):
        return False
    if any((rank_of(value) or 0) > 1 for value in node.inputs[2:]):
        return False
    if node.op_type in UNARY or node.op_type in BINARY:
        return True
    # Normalizations must work along the last axis
    if node.op_type not in ALONG_AXIS:
        return False
    if node.op_type == "LayerNormalization" and rank_of(node.inputs[1]) != 1:
        return False
    rank = rank_of(node.outputs[0]) or 0
    return node.attributes.get_int("axis", -1) in (-1, rank - 1)


@dataclasses.dataclass(frozen=True)
class _Operand:
    """An operand of the node that is computed once."""

    value: ir.Value  # the operand now, with its repetitions
    shape: tuple[int, ...]  # without them
    repeated: RepeatedAxes | None = None  # where it is read without them
    numbers: Array | None = None  # those of a constant, without repetitions


@dataclasses.dataclass(frozen=True)
class _Plan:
    """A node's new operands, and the shape of its result once and with its repeats."""

    operands: tuple[_Operand, ...]
    small: tuple[int, ...]
    large: tuple[int, ...]


def before_repeat(call: FusedCall) -> bool:
    """Compute a node before the repetition of what it reads, where that pays."""
    plan = _plan(call.node)
    if plan is None or not _pays(call.node, plan):
        return False
    _rewrite(call, plan)
    return True


def _plan(node: ir.Node) -> _Plan | None:
    shape = static_shape(node.outputs[0])
    if not shape or not is_standard(node):
        return None
    if node.op_type == "Concat":
        return _joined(node, shape)
    value = node.inputs[0] if node.inputs else None
    if node.op_type == "Transpose" and value is not None:
        return _turned(node, value)
    if value is None or not (is_product(node) or is_row_wise(node)):
        return None
    # Two operands broadcast; one operand is mapped as it is
    if node.op_type in BINARY:
        return _combined(node, shape)
    # An operator along the last axis needs it whole
    repeated, width_shape = repeated_axes(value), static_shape(value)
    if repeated is None or not width_shape:
        return None
    operand = _Operand(value, repeated.small, repeated)
    if node.op_type in UNARY:
        return _Plan((operand,), repeated.small, repeated.large)
    if not repeated.small[-1] == repeated.large[-1] == width_shape[-1]:
        return None
    ends = shape[-1:]
    return _Plan((operand,), repeated.small[:-1] + ends, repeated.large[:-1] + ends)


def _turned(node: ir.Node, value: ir.Value) -> _Plan | None:
    """Plan a Transpose of a value that repeats."""
    repeated, order = repeated_axes(value), permutation_of(node)
    if repeated is None or order is None or repeated.large != static_shape(value):
        return None
    small = tuple(repeated.small[axis] for axis in order)
    large = tuple(repeated.large[axis] for axis in order)
    return _Plan((_Operand(value, repeated.small, repeated),), small, large)


def _combined(node: ir.Node, shape: tuple[int, ...]) -> _Plan | None:
    """Plan an element-wise operator of two operands, each of which may repeat."""
    # The smaller operand is repeated by the operator itself
    operands: list[_Operand] = []
    for value in node.inputs:
        full = static_shape(value)
        if value is None or full is None:
            return None
        same = value.dtype == node.outputs[0].dtype and not holds_numbers(value)
        repeated = repeated_axes(value) if same else None
        if repeated is not None and repeated.large != full:
            return None
        small = full if repeated is None else repeated.small
        operands.append(_Operand(value, small, repeated))
    if all(operand.repeated is None for operand in operands):
        return None
    small = np.broadcast_shapes(*(operand.shape for operand in operands))
    return _Plan(tuple(operands), small, shape)


def _joined(node: ir.Node, shape: tuple[int, ...]) -> _Plan | None:
    """Plan a Concat whose operands all repeat along the same axes, constants too."""
    values = [value for value in node.inputs if value is not None]
    stored = {value: array_of(value) for value in values if holds_numbers(value)}
    common = set(range(len(shape))) - {node.attributes.get_int("axis", 0) % len(shape)}
    repeats: dict[ir.Value, RepeatedAxes] = {}
    if len(stored) == len(values):
        return None
    # The axes along which every operand repeats
    for value in values:
        one = None if value in stored else repeated_axes(value)
        if one is not None and one.large == static_shape(value):
            repeats[value] = one
            common = {at for at in common if one.small[at] != one.large[at]}
        elif value not in stored:
            return None
    # A constant repeats along an axis if all its slices are equal
    for array in stored.values():
        assert array is not None
        common = {at for at in common if np.all(array == np.take(array, [0], at))}
    if not common:
        return None

    def once(sizes: Sequence[int]) -> tuple[int, ...]:
        return tuple(1 if at in common else size for at, size in enumerate(sizes))

    operands = []
    for value in values:
        small, array = once(static_shape(value) or ()), stored.get(value)
        if array is not None:
            array = array[tuple(map(slice, small))]
        operands.append(_Operand(value, small, repeats.get(value), array))
    return _Plan(tuple(operands), once(shape), shape)


def _pays(node: ir.Node, plan: _Plan) -> bool:
    """Return whether all that is computed once is more than what is written anew."""
    result, item = node.outputs[0], item_bytes(node.outputs[0])
    before, moved = work(node), math.prod(plan.small) * item
    products = (macs(node) or 0) * math.prod(plan.small) / math.prod(plan.large)
    after = 1.0 + products / MACS_PER_NODE
    for operand in plan.operands:
        moved += math.prod(operand.shape) * item
        if operand.repeated is None:
            continue
        # The nodes of a repetition that only this one needs
        nodes, small = operand.repeated.nodes, operand.repeated.small
        owned = itertools.takewhile(lambda n: sole_reader(n.outputs[0]), nodes)
        before += sum(map(work, owned))
        if static_shape(operand.repeated.source) != small:
            after += 1.0
        if operand.shape != small:
            moved += (math.prod(operand.shape) + math.prod(small)) * item
            after += 1.0
    # Repeating the result, and giving it its shape
    if plan.small != plan.large:
        moved += (math.prod(plan.small) + math.prod(plan.large)) * item
        after += 1.0
    after += plan.large != static_shape(result)
    return before - after > moved / MOVED_BYTES_PER_NODE


def _rewrite(call: FusedCall, plan: _Plan) -> None:
    node, rank = call.node, len(plan.small)
    # Operands once; an operator along the last axis keeps to it
    inputs = [_written(call, operand) for operand in plan.operands]
    inputs.extend(node.inputs[len(inputs) :])
    attributes = {key: option.value for key, option in node.attributes.items()}
    call.sources = (node,)
    if node.op_type in ALONG_AXIS:
        attributes["axis"] = rank - 1
    new = call.add(node.op_type, inputs, attributes)
    # Repeat the result, unless its readers broadcast it themselves
    axes = [operand.repeated for operand in plan.operands if operand.repeated]
    call.sources = (node, *dict.fromkeys(one for each in axes for one in each.nodes))
    new = _expanded(call, call.view(new, plan.small), plan.large)
    replace(call, call.view(new, static_shape(node.outputs[0]) or ()))


def _expanded(call: FusedCall, value: ir.Value, shape: tuple[int, ...]) -> ir.Value:
    if static_shape(value) == shape:
        return value
    return call.add("Expand", [value, call.integers(shape)])


def _written(call: FusedCall, operand: _Operand) -> ir.Value | None:
    """Return what a node reads instead, written where needed."""
    axes = operand.repeated
    if operand.numbers is not None:
        return call.constant(operand.numbers, "once")
    if axes is None:
        return operand.value
    call.sources = axes.nodes
    return _expanded(call, call.view(axes.source, axes.small), operand.shape)
