"""Views of values under layout operators, and walks along them."""

import dataclasses
import math
from collections.abc import Iterator, Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import input_at, is_standard, static_shape
from me2e_compress.graph.nodes import (
    VIEWS,
    integers_of,
    numbers_of,
    permutation_of,
    producer_of,
    sole_maker,
    sole_reader,
)
from me2e_compress.passes.digits import Digits, Layout, before, regrouped


@dataclasses.dataclass(frozen=True)
class View:
    """A value with the moved elements of another: other = scale * this + shift.

    ``layout`` are the digits of the other's indices that its dimensions are made of.
    """

    value: ir.Value
    layout: Layout
    scale: float = 1.0
    shift: float = 0.0


@dataclasses.dataclass(frozen=True)
class Selection:
    """A view of ``size`` indices from ``start`` on of one dimension.

    The layout of ``view``, the value before the selection, is that of the part.
    """

    view: View
    axis: int
    start: int
    size: int


def sources(view: View) -> Iterator[View | Selection]:
    """Walk from a value, itself first, back to where its elements come from.

    A selection, if it meets one, is the last.
    """
    while True:
        yield view
        earlier = _earlier(view)
        if isinstance(earlier, Selection):
            yield earlier
        if not isinstance(earlier, View):
            return
        view = earlier


def results(view: View) -> Iterator[View]:
    """Walk from a value, itself first, through sole readers that only move it."""
    while True:
        yield view
        reader = sole_reader(view.value)
        after = None if reader is None else _after(reader, view)
        if after is None:
            return
        view = after


def joined(selections: Sequence[Selection], digits: Digits) -> View | None:
    """Return the view that consecutive parts make up together; None if they do not."""
    first, start = selections[0], 0
    axis, layout = first.axis, first.view.layout
    # The parts must be adjacent and equal in all other respects
    for selection in selections:
        own = selection.view.layout
        beside = (*own[:axis], layout[axis], *own[axis + 1 :])
        alike = dataclasses.replace(selection.view, layout=beside) == first.view
        if not alike or selection.axis != axis or selection.start != start:
            return None
        start += selection.size
    whole = (static_shape(first.view.value) or ())[axis]
    if start != whole or math.prod(d.size for d in digits) != start:
        return None
    layout = (*layout[:axis], digits, *layout[axis + 1 :])
    return dataclasses.replace(first.view, layout=layout)


def operands(view: View, op_type: str) -> tuple[View, ...] | None:
    """Return both operands of an Add or Mul that is read once; None of other values."""
    node = sole_maker(view.value, op_type)
    shapes = [] if node is None else [static_shape(value) for value in node.inputs]
    if node is None or None in shapes:
        return None
    return tuple(
        dataclasses.replace(view, value=operand, layout=aligned(view.layout, shape))
        for operand, shape in zip(node.inputs, shapes, strict=True)
        if operand is not None and shape is not None
    )


def aligned(layout: Layout, shape: Sequence[int]) -> Layout:
    """Return the layout of a broadcast operand: no digits where its size is 1."""
    last = layout[len(layout) - len(shape) :]
    return tuple(
        digits if size > 1 else () for digits, size in zip(last, shape, strict=True)
    )


def _earlier(view: View) -> View | Selection | None:
    node = producer_of(view.value)
    if node is None or not is_standard(node) or not node.inputs:
        return None
    # Selections and scales are handled apart
    if node.op_type in ("Gather", "Slice", "Split"):
        return _selected(node, view)
    if node.op_type in ("Add", "Div", "Mul", "Sub"):
        return _unscaled(node, view)
    source = node.inputs[0]
    shape = static_shape(source)
    if source is None or shape is None:
        return None
    # Move the digits back through the operator
    expands = node.op_type == "Expand"
    layout = aligned(view.layout, shape) if expands else before(node, view.layout)
    if layout is None:
        return None
    return dataclasses.replace(view, value=source, layout=layout)


def _after(node: ir.Node, view: View) -> View | None:
    result = node.outputs[0]
    shape, order = static_shape(result), permutation_of(node)
    if not is_standard(node) or node.inputs[0] is not view.value or shape is None:
        return None
    layout: Layout | None = None
    if node.op_type in VIEWS:
        layout = regrouped(view.layout, shape)
    elif node.op_type == "Transpose":
        layout = tuple(view.layout[axis] for axis in order or ())
    if layout is None:
        return None
    return dataclasses.replace(view, value=result, layout=layout)


def _unscaled(node: ir.Node, view: View) -> View | None:
    left, right = node.inputs[0], node.inputs[1]
    constant, source = _number(right), left
    if constant is None and node.op_type in ("Add", "Mul"):
        constant, source = _number(left), right
    if constant is None or source is None or source.dtype != view.value.dtype:
        return None
    if static_shape(source) != static_shape(view.value) or constant == 0.0:
        return None
    # Compose with the scale and shift so far
    scale, shift = view.scale, view.shift
    if node.op_type == "Mul":
        scale *= constant
    elif node.op_type == "Div":
        scale /= constant
    else:
        shift += scale * (constant if node.op_type == "Add" else -constant)
    return dataclasses.replace(view, value=source, scale=scale, shift=shift)


def _number(value: ir.Value | None) -> float | None:
    numbers = numbers_of(value)
    if numbers is None or numbers.size == 0 or np.ptp(numbers) != 0.0:
        return None
    return float(numbers.flat[0])


def _selected(node: ir.Node, view: View) -> Selection | None:
    """Return the part of a dimension that a Gather, Slice or Split takes."""
    source, made = node.inputs[0], static_shape(view.value)
    shape = static_shape(source)
    if source is None or shape is None:
        return None
    # One index of a Gather, the range of a Slice, one part of a Split
    axis, size = node.attributes.get_int("axis", 0) % len(shape), 1
    if node.op_type == "Gather":
        index = integers_of(input_at(node, 1))
        if index is None or len(index) != 1:
            return None
        start = index[0] % shape[axis]
    elif node.op_type == "Slice":
        starts, axes = integers_of(input_at(node, 1)), integers_of(input_at(node, 3))
        steps = integers_of(input_at(node, 4)) if len(node.inputs) > 4 else [1]
        if starts is None or len(starts) != 1 or steps != [1] or made is None:
            return None
        axis = (0 if axes is None else axes[0]) % len(shape)
        first = starts[0] + shape[axis] if starts[0] < 0 else starts[0]
        start, size = min(first, shape[axis]), made[axis]
    else:
        parts = [static_shape(part) for part in node.outputs]
        at = view.value.index() or 0
        known = [part[axis] for part in parts[: at + 1] if part is not None]
        if len(known) <= at:
            return None
        start, size = sum(known[:at]), known[at]
    # A Gather of one index may drop the axis
    layout = list(view.layout)
    if node.op_type == "Gather" and len(made or ()) != len(shape):
        layout.insert(axis, ())
    whole = dataclasses.replace(view, value=source, layout=tuple(layout))
    return Selection(whole, axis, start, size)
