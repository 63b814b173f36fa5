"""Merge two consecutive nodes into one that does exactly the same.

Each rule rewrites the graph around a node and returns the node to look at again (the
node itself, now unread, where nothing is left of it), or None where it does not apply.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import provenance, static_shape
from me2e_compress.graph.nodes import ELEMENTWISE, VIEWS, integers_of, permutation_of
from me2e_compress.graph.rewrite import (
    add_constant,
    bypass,
    is_standard,
    put,
    sole_reader,
    value_names,
)
from me2e_compress.passes.eliminate_redundant.identities import moves_nothing

_RESHAPING = VIEWS - {"Identity"}

BROADCASTING = frozenset({*ELEMENTWISE, "Where"})

WIDENS: dict[ir.DataType, str] = {
    ir.DataType.BOOL: "UINT8 INT8 INT16 INT32 INT64 FLOAT16 FLOAT DOUBLE",
    ir.DataType.UINT8: "UINT16 UINT32 UINT64 INT16 INT32 INT64 FLOAT16 FLOAT DOUBLE",
    ir.DataType.INT8: "INT16 INT32 INT64 FLOAT16 FLOAT DOUBLE",
    ir.DataType.INT16: "INT32 INT64 FLOAT DOUBLE",
    ir.DataType.INT32: "INT64 DOUBLE",
    ir.DataType.UINT32: "INT64 UINT64 DOUBLE",
    ir.DataType.FLOAT16: "FLOAT DOUBLE",
    ir.DataType.FLOAT: "DOUBLE",
}
"""The types that hold every value of a type: a Cast there loses nothing."""


@dataclasses.dataclass
class MergeSite:
    """A graph that is being rewritten, and the constants made for it so far."""

    graph: ir.Graph
    opset: int
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
    if not is_standard(node):
        return None
    if node.op_type in BROADCASTING:
        return _drop_expand(node, site)
    if node.op_type in _RESHAPING or node.op_type == "Transpose":
        return _views(node, site) or (
            _transposes(node, site) if node.op_type == "Transpose" else None
        )
    rule = RULES.get(node.op_type)
    return None if rule is None else rule(node, site)


def _before(node: ir.Node, index: int = 0) -> ir.Node | None:
    value = node.inputs[index]
    inner = None if value is None else value.producer()
    if inner is None or not is_standard(inner) or inner.graph is not node.graph:
        return None
    return inner


def _is_view(node: ir.Node) -> bool:
    if node.op_type == "Transpose":
        return moves_nothing(node)
    return node.op_type in _RESHAPING


def _views(node: ir.Node, site: MergeSite) -> ir.Node | None:
    """Merge consecutive Reshape, Flatten, Squeeze and Unsqueeze into one or none."""
    inner, sizes = _before(node), static_shape(node.outputs[0])
    if inner is None or sizes is None or 0 in sizes or site.opset < 5:
        return None
    if not _is_view(node) or not _is_view(inner):
        return None
    source = inner.inputs[0]
    if source is None:
        return None
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
    if outer_perm is None or inner_perm is None:
        return None
    # Compose both permutations; drop the pair if nothing moves
    perm = [inner_perm[axis] for axis in outer_perm]
    source = inner.inputs[0]
    if source is None:
        return None
    if perm == sorted(perm) and bypass(node.outputs[0], source):
        return node
    if sole_reader(inner.outputs[0]) is None:
        return None
    return put(
        node,
        "Transpose",
        [source],
        by=site.by,
        sources=[inner],
        attributes={"perm": perm},
    )


def _casts(node: ir.Node, site: MergeSite) -> ir.Node | None:
    inner = _before(node)
    if inner is None or inner.op_type != "Cast" or inner.inputs[0] is None:
        return None
    source, middle = inner.inputs[0].dtype, inner.outputs[0].dtype
    if source is None or middle is None:
        return None
    # The first Cast must lose nothing
    if middle.name not in WIDENS.get(source, "").split():
        return None
    if sole_reader(inner.outputs[0]) is None and source != node.outputs[0].dtype:
        return None
    return put(
        node,
        "Cast",
        inner.inputs[:1],
        by=site.by,
        sources=[inner],
        attributes={name: attr.value for name, attr in node.attributes.items()},
    )


def _slices(node: ir.Node, site: MergeSite) -> ir.Node | None:
    inner = _before(node)
    if inner is None or inner.op_type != "Slice" or site.opset < 10:
        return None
    if sole_reader(inner.outputs[0]) is None:
        return None
    first, second = _window(inner), _window(node)
    if first is None or second is None or set(first[2]) & set(second[2]):
        return None
    # Concatenate starts, ends, axes and steps; drop steps of 1
    name = node.outputs[0].name or ""
    inputs = [
        add_constant(site.graph, np.array([*one, *two], np.int64), f"{name}_{part}")
        for part, one, two in zip(
            ("starts", "ends", "axes", "steps"), first, second, strict=True
        )
    ]
    if all(step == 1 for step in (*first[3], *second[3])):
        del site.graph.initializers[inputs.pop().name or ""]
    return put(node, "Slice", [inner.inputs[0], *inputs], by=site.by, sources=[inner])


def _window(node: ir.Node) -> list[list[int]] | None:
    """Return starts, ends, axes (from the front) and steps, if all are constant."""
    rank = 0 if node.outputs[0].shape is None else len(node.outputs[0].shape)
    given: list[list[int] | None] = []
    for value in node.inputs[1:]:
        given.append(integers_of(value))
        if value is not None and given[-1] is None:
            return None
    # Fill in the defaults of axes and steps
    starts, ends, axes, steps = [*given, None, None, None, None][:4]
    if not rank or starts is None or ends is None:
        return None
    axes = list(range(len(starts))) if axes is None else axes
    steps = [1] * len(starts) if steps is None else steps
    return [starts, ends, [axis % rank for axis in axes], steps]


def _concats(node: ir.Node, site: MergeSite) -> ir.Node | None:
    axis = node.attributes.get_int("axis", 0)
    inputs: list[ir.Value | None] = []
    inner_nodes: list[ir.Node] = []
    # Take in the operands of Concats that nothing else reads
    for index, value in enumerate(node.inputs):
        inner = _before(node, index)
        if (
            inner is not None
            and inner.op_type == "Concat"
            and inner.attributes.get_int("axis", 0) == axis
            and sole_reader(inner.outputs[0]) is node
        ):
            inputs.extend(inner.inputs)
            inner_nodes.append(inner)
        else:
            inputs.append(value)
    if not inner_nodes:
        return None
    return put(
        node,
        "Concat",
        inputs,
        by=site.by,
        sources=inner_nodes,
        attributes={"axis": axis},
    )


def _drop_expand(node: ir.Node, site: MergeSite) -> ir.Node | None:
    """Drop an Expand, or a Tile that only repeats, before a broadcasting operator."""
    target = static_shape(node.outputs[0])
    if target is None or site.opset < 8:
        return None
    for index, value in enumerate(node.inputs):
        inner = _before(node, index)
        if inner is None or inner.op_type not in ("Expand", "Tile"):
            continue
        source = inner.inputs[0]
        small, large = static_shape(source), static_shape(value)
        if small is None or large is None or not _broadcasts(small, large):
            continue
        # The other operands must still broadcast to the same shape
        others = [static_shape(other) for other in node.inputs]
        others[index] = small
        shapes = [shape for shape in others if shape is not None]
        if len(shapes) == len(others) and np.broadcast_shapes(*shapes) == target:
            node.replace_input_with(index, source)
            provenance.inherit(node, (node, inner), by=site.by)
            return node
    return None


def _broadcasts(small: tuple[int, ...], large: tuple[int, ...]) -> bool:
    pairs = zip(small[::-1], large[::-1], strict=False)
    return len(small) <= len(large) and all(one in (1, two) for one, two in pairs)


RULES: dict[str, Rule] = {"Cast": _casts, "Concat": _concats, "Slice": _slices}
