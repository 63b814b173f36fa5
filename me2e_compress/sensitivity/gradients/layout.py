"""Gradients of what moves elements, or samples between them."""

import math
from collections.abc import Mapping, Sequence

import onnx_ir as ir

from me2e_compress.graph.nodes import (
    input_at,
    integers_at,
    integers_of,
    permutation_of,
)
from me2e_compress.sensitivity.gradients.tape import (
    Attributes,
    Found,
    NoRuleError,
    Rule,
    Tape,
    given,
    sizes_of,
)


def _reshape(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    return [t.shaped(g, sizes_of(node.inputs[0]))]


def _transpose(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    order = _whole(permutation_of(node))
    return [
        t.op("Transpose", [g], {"perm": [order.index(at) for at in range(len(order))]})
    ]


def _expand(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    return [t.narrowed(g, node.outputs[0], given(node.inputs[0]))]


def _tile(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    sizes = sizes_of(node.inputs[0])
    repeats = [m // n for m, n in zip(sizes_of(node.outputs[0]), sizes, strict=True)]
    apart = [each for pair in zip(repeats, sizes, strict=True) for each in pair]
    return [t.total(t.shaped(g, apart), range(0, len(apart), 2), keep=False)]


def _concat(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    axis, start, found = node.attributes.get_int("axis", 0), 0, []
    for each in node.inputs:
        size = sizes_of(each)[axis]
        found.append(_part(t, g, axis, start, start + size))
        start += size
    return found


def _part(t: Tape, g: ir.Value, axis: int, start: int, end: int) -> ir.Value:
    return t.op("Slice", [g, t.ints([start]), t.ints([end]), t.ints([axis])])


def _slice(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    x, made = given(node.inputs[0]), list(sizes_of(node.outputs[0]))
    names = enumerate(("starts", "ends", "axes", "steps"), start=1)
    starts, ends, axes, steps = (integers_at(node, name, at) for at, name in names)
    if starts is None or ends is None:
        raise NoRuleError("its borders are not constant")
    axes = axes or [*range(len(starts))]
    steps = steps or [1] * len(starts)
    for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
        size = sizes_of(x)[axis]
        # an end before the first element is written as a negative number
        stop = None if step < 0 and end < -size else end
        places = [*range(size)[start:stop:step]]
        g = _in_place(t, x, g, made, axis, places)
        made[axis] = size
    return [g]


def _in_place(
    t: Tape,
    x: ir.Value,
    g: ir.Value,
    shape: Sequence[int],
    axis: int,
    places: list[int] | ir.Value,
) -> ir.Value:
    """Add the slices of g, which has this shape, to zeros, at their places in x."""
    axis, size = axis % len(shape), sizes_of(x)[axis]
    if isinstance(places, list):
        if places == [*range(places[0], places[0] + len(places))]:
            pads = [0] * 2 * len(shape)
            pads[axis], pads[axis + len(shape)] = places[0], size - places[-1] - 1
            return t.op("Pad", [g, t.ints(pads)]) if any(pads) else g
        places = t.ints(places)
    column = t.shaped(places, [-1] + [1] * (len(shape) - axis - 1))
    wide = t.op("Expand", [column, t.ints(shape)])
    zeros = t.zeros([*shape[:axis], size, *shape[axis + 1 :]], x)
    options: Attributes = {"axis": axis, "reduction": "add"}
    return t.op("ScatterElements", [zeros, wide, g], options)


def _gather(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    x, where = given(node.inputs[0]), given(node.inputs[1])
    sizes = sizes_of(x)
    axis = node.attributes.get_int("axis", 0) % len(sizes)
    flat = [*sizes[:axis], math.prod(sizes_of(where)), *sizes[axis + 1 :]]
    known = integers_of(where)
    places = where if known is None else [at % sizes[axis] for at in known]
    return [_in_place(t, x, t.shaped(g, flat), flat, axis, places)]


def _gather_elements(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    x, axis = given(node.inputs[0]), node.attributes.get_int("axis", 0)
    options: Attributes = {"axis": axis, "reduction": "add"}
    return [
        t.op("ScatterElements", [t.zeros(sizes_of(x), x), node.inputs[1], g], options)
    ]


def _gather_nd(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    x = given(node.inputs[0])
    if node.attributes.get_int("batch_dims", 0):
        raise NoRuleError("no rule for batch_dims")
    zeros = t.zeros(sizes_of(x), x)
    return [t.op("ScatterND", [zeros, node.inputs[1], g], {"reduction": "add"})]


def _scatter_nd(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    places, updates = given(node.inputs[1]), given(node.inputs[2])
    to_updates = t.op("GatherND", [g, places])
    how = node.attributes.get_string("reduction", "none")
    if how == "add":
        return [g, None, to_updates]
    if how != "none":
        raise NoRuleError(f"no rule for {how}")
    gone = t.zeros(sizes_of(updates), updates)
    return [t.op("ScatterND", [g, places, gone]), None, to_updates]


def _scatter_elements(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    places, updates = given(node.inputs[1]), given(node.inputs[2])
    axis = {"axis": node.attributes.get_int("axis", 0)}
    to_updates = t.op("GatherElements", [g, places], axis)
    how = node.attributes.get_string("reduction", "none")
    if how == "add":
        return [g, None, to_updates]
    if how != "none":
        raise NoRuleError(f"no rule for {how}")
    gone = t.zeros(sizes_of(updates), updates)
    return [t.op("ScatterElements", [g, places, gone], axis), None, to_updates]


def _top_k(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    x, axis = given(node.inputs[0]), node.attributes.get_int("axis", -1)
    options: Attributes = {"axis": axis, "reduction": "add"}
    return [
        t.op("ScatterElements", [t.zeros(sizes_of(x), x), node.outputs[1], g], options)
    ]


def _pad(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    sizes, pads = sizes_of(node.inputs[0]), integers_at(node, "pads", 1)
    constant = node.attributes.get_string("mode", "constant") == "constant"
    if pads is None or not constant or min(pads) < 0 or input_at(node, 3) is not None:
        raise NoRuleError("no rule but for constant borders of known width")
    starts = pads[: len(sizes)]
    ends = [start + size for start, size in zip(starts, sizes, strict=True)]
    return [t.op("Slice", [g, t.ints(starts), t.ints(ends), t.ints(range(len(sizes)))])]


def _whole(numbers: list[int] | None) -> list[int]:
    if numbers is None:
        raise NoRuleError("not a constant")
    return numbers


RULES: Mapping[str, Rule] = {
    "Reshape": _reshape,
    "Flatten": _reshape,
    "Squeeze": _reshape,
    "Unsqueeze": _reshape,
    "Transpose": _transpose,
    "Expand": _expand,
    "Tile": _tile,
    "Concat": _concat,
    "Slice": _slice,
    "Gather": _gather,
    "GatherElements": _gather_elements,
    "GatherND": _gather_nd,
    "ScatterND": _scatter_nd,
    "ScatterElements": _scatter_elements,
    "TopK": _top_k,
    "Pad": _pad,
}
