"""Rules that remove nodes that return their input, and merge pairs of nodes.

A rule of an identity returns the value that a node's first output equals, bit for bit,
or None. Adding 0.0 is not an identity: -0.0 + 0.0 is +0.0.

A rule of a pair rewrites the graph around a node and returns the node to visit next
(the node itself, now unread, if it was removed), or None where it does not apply.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import array_of, rank_of, static_shape
from me2e_compress.graph.nodes import (
    VIEWS,
    draws,
    input_at,
    integers_at,
    integers_of,
    is_read,
    is_standard,
    maker,
    permutation_of,
    sole_reader,
)
from me2e_compress.graph.rewrite import add_constant, bypass, put, value_names

Identity = Callable[[ir.Node], ir.Value | None]


def identity_of(node: ir.Node) -> ir.Value | None:
    """Return the value that a node only repeats; None if it does something."""
    if not is_standard(node) or not node.outputs:
        return None
    rule = IDENTITIES.get(node.op_type)
    if rule is None or any(is_read(value) for value in node.outputs[1:]):
        return None
    return rule(node)


def same_shape(one: ir.Value | None, other: ir.Value | None) -> bool:
    """Return whether two values certainly have the same shape."""
    shape = static_shape(one)
    return shape is not None and shape == static_shape(other)


def _if_same_shape(node: ir.Node) -> ir.Value | None:
    return node.inputs[0] if same_shape(node.inputs[0], node.outputs[0]) else None


def _if_alone(node: ir.Node) -> ir.Value | None:
    """One operand of a Concat or Max, one part of a Split."""
    values = node.outputs if node.op_type == "Split" else node.inputs
    return node.inputs[0] if len(values) == 1 else None


def _cast(node: ir.Node) -> ir.Value | None:
    source = node.inputs[0]
    if source is None or source.dtype is None:
        return None
    return source if source.dtype == node.attributes.get_int("to", 0) else None


def _transpose(node: ir.Node) -> ir.Value | None:
    order = permutation_of(node)
    if order is not None and order == sorted(order):
        return node.inputs[0]
    return _if_same_shape(node) if moves_nothing(node) else None


def moves_nothing(node: ir.Node) -> bool:
    """Return whether a Transpose only moves axes of size 1, as a Reshape would."""
    shape, order = static_shape(node.inputs[0]), permutation_of(node)
    if shape is None or order is None:
        return False
    real = [axis for axis in order if shape[axis] != 1]
    return real == sorted(real)


def _slice(node: ir.Node) -> ir.Value | None:
    steps = input_at(node, 4)
    known = [] if steps is None else integers_of(steps)
    if known is None or {*known} - {1}:
        return None
    return _if_same_shape(node) or _sliced_part(node)


def _sliced_part(node: ir.Node) -> ir.Value | None:
    """Return the operand of a Concat that a Slice takes out again, if it is one."""
    # Bounds of the Slice along one axis, that of the Concat
    inner, shape = maker(node.inputs[0], "Concat"), static_shape(node.inputs[0])
    starts, ends = integers_at(node, "starts", 1), integers_at(node, "ends", 2)
    axes = integers_at(node, "axes", 3)
    if inner is None or shape is None or not starts or not ends:
        return None
    if axes is None or len(axes) != 1:
        return None
    axis = axes[0] % len(shape)
    if inner.attributes.get_int("axis", 0) % len(shape) != axis:
        return None
    # Walk over the operands up to the one between these bounds
    first, last, _ = slice(starts[0], ends[0]).indices(shape[axis])
    at = 0
    for part in inner.inputs:
        sizes = static_shape(part)
        if sizes is None or at > first:
            return None
        if (at, at + sizes[axis]) == (first, last):
            return part
        at += sizes[axis]
    return None


def _pad(node: ir.Node) -> ir.Value | None:
    pads = integers_at(node, "pads", 1)
    return node.inputs[0] if pads is not None and not any(pads) else None


def _times_one(node: ir.Node) -> ir.Value | None:
    """A product with ones, or a division by ones, that keeps the shape."""
    for index in (1, 0) if node.op_type == "Mul" else (1,):
        ones, source = array_of(node.inputs[index]), node.inputs[1 - index]
        if ones is None or source is None or not ones.size or (ones != 1).any():
            continue
        # Broadcasting the ones must keep the shape of the other operand
        rank = rank_of(source)
        is_small = ones.size == 1 and rank is not None and ones.ndim <= rank
        same = is_small or same_shape(source, node.outputs[0])
        if same and source.dtype == node.outputs[0].dtype:
            return source
    return None


def _where(node: ir.Node) -> ir.Value | None:
    """A choice between a value and itself."""
    yes, no = node.inputs[1:]
    return yes if yes is no and same_shape(yes, node.outputs[0]) else None


IDENTITIES: dict[str, Identity] = {
    **dict.fromkeys(("Concat", "Max", "Mean", "Min", "Split", "Sum"), _if_alone),
    **dict.fromkeys(("Expand", "Flatten", "Reshape", "Squeeze"), _if_same_shape),
    **dict.fromkeys(("Tile", "Unsqueeze"), _if_same_shape),
    "Cast": _cast,
    "Div": _times_one,
    "Dropout": lambda node: None if draws(node) else node.inputs[0],
    "Identity": lambda node: node.inputs[0],
    "Mul": _times_one,
    "Pad": _pad,
    "Slice": _slice,
    "Transpose": _transpose,
    "Where": _where,
}


_RESHAPING = VIEWS - {"Identity"}


@dataclasses.dataclass
class MergeSite:
    """A graph that is being rewritten, and the constants made for it so far."""

    graph: ir.Graph
    by: str
    shapes: dict[tuple[int, ...], ir.Value] = dataclasses.field(default_factory=dict)
    names: set[str] = dataclasses.field(default_factory=set)

    def shape(self, sizes: tuple[int, ...], reader: ir.Node) -> ir.Value:
        """Return the initializer of a shape, named uniquely after its first reader."""
        value = self.shapes.get(sizes)
        if value is None or value.graph is not self.graph:
            name, array = f"{reader.outputs[0].name}_shape", np.array(sizes, np.int64)
            self.names = self.names or value_names(self.graph)
            value = add_constant(self.graph, array, name, self.names)
            self.shapes[sizes] = value
        return value


Rule = Callable[[ir.Node, MergeSite], ir.Node | None]


def merge(node: ir.Node, site: MergeSite) -> ir.Node | None:
    """Merge a node with the one before it, if one node can do both."""
    rules = PAIRS.get(node.op_type, ()) if is_standard(node) else ()
    return next(filter(None, (rule(node, site) for rule in rules)), None)


def _before(node: ir.Node, index: int = 0) -> ir.Node | None:
    """Return the standard node of the same graph that makes an input."""
    value = node.inputs[index]
    inner = None if value is None else value.producer()
    own = inner is not None and is_standard(inner) and inner.graph is node.graph
    return inner if own else None


def _is_view(node: ir.Node) -> bool:
    transposes = node.op_type == "Transpose"
    return moves_nothing(node) if transposes else node.op_type in _RESHAPING


def _views(node: ir.Node, site: MergeSite) -> ir.Node | None:
    """Merge consecutive Reshape, Flatten, Squeeze and Unsqueeze into one or none."""
    inner, sizes = _before(node), static_shape(node.outputs[0])
    if inner is None or sizes is None or 0 in sizes:
        return None
    if not _is_view(node) or not _is_view(inner):
        return None
    source = inner.inputs[0]
    if source is None:
        return None
    # Back to the shape before, or one Reshape in place of both
    if static_shape(source) == sizes and bypass(node.outputs[0], source):
        return node
    if sole_reader(inner.outputs[0]) is None:
        return None
    shape = site.shape(sizes, node)
    return put(node, "Reshape", [source, shape], by=site.by, sources=[inner])


def _transposes(node: ir.Node, site: MergeSite) -> ir.Node | None:
    inner = _before(node)
    if inner is None or inner.op_type != "Transpose":
        return None
    outer_perm, inner_perm = permutation_of(node), permutation_of(inner)
    source = inner.inputs[0]
    if outer_perm is None or inner_perm is None or source is None:
        return None
    # Compose both permutations; drop the pair if nothing moves
    perm = [inner_perm[axis] for axis in outer_perm]
    if perm == sorted(perm) and bypass(node.outputs[0], source):
        return node
    if sole_reader(inner.outputs[0]) is None:
        return None
    by, sources, options = site.by, [inner], {"perm": perm}
    return put(node, "Transpose", [source], by=by, sources=sources, attributes=options)


# Rules by operator; of several, the first that applies.
PAIRS: dict[str, tuple[Rule, ...]] = {
    **dict.fromkeys(_RESHAPING, (_views,)),
    "Transpose": (_views, _transposes),
}
