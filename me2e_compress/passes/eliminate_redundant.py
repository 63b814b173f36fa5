"""Remove what does nothing or is there twice."""

import dataclasses
from collections import Counter
from collections.abc import Callable

import numpy as np
import onnx_ir as ir
import onnx_ir.passes.common as common

from me2e_compress.graph import (
    array_of,
    infer_shapes,
    opset_of,
    provenance,
    rank_of,
    static_shape,
)
from me2e_compress.graph.digest import digest_of_tensor
from me2e_compress.graph.nodes import (
    VIEWS,
    attribute_values,
    draws,
    graphs_of,
    has_subgraph,
    input_at,
    integers_at,
    integers_of,
    is_read,
    is_standard,
    maker,
    permutation_of,
    sole_reader,
)
from me2e_compress.graph.rewrite import (
    add_constant,
    bypass,
    can_replace,
    put,
    remove_dead,
    remove_node,
    value_names,
)
from me2e_compress.graph.rewrite.raise_opset import OLDEST_OPSET
from me2e_compress.passes.base import Context, Pass, PassResult

# Each round works on what the last one changed; real graphs need three or four.
ROUNDS = 32


@dataclasses.dataclass(frozen=True)
class EliminateRedundant(Pass):
    """Remove nodes that change nothing, merge pairs, and share equal ones.

    Given:   x -> Identity -> Transpose -> Transpose -> y;  Add(a, b), Add(b, a)
    Result:  x -> y;  one Add

    Exact to the bit: x + 0.0 stays, since it turns -0.0 into +0.0.
    """

    name = "eliminate-redundant"
    exact = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Apply the rules until none applies, then drop unread nodes."""
        if opset_of(model) < OLDEST_OPSET:  # operators had other rules then
            return PassResult(model, 0)
        tally: Counter[str] = Counter()
        tally["unread"] += remove_dead(model.graph)
        # Repeat: each round enables rules for the next
        for _ in range(ROUNDS):
            before = tally.total()
            for body in graphs_of(model.graph):
                self._round(body, tally)
            tally["unread"] += remove_dead(model.graph)
            if tally.total() == before:
                break
            # what read a removed node may know its shape now, and another rule apply
            values = (value for node in model.graph for value in node.outputs)
            if any(static_shape(value) is None for value in values):
                infer_shapes(model)
        # Remove functions and opsets that are no longer used
        declared = _count_declared(model)
        functions = common.RemoveUnusedFunctionsPass()  # type: ignore[no-untyped-call]
        functions(model)
        common.RemoveUnusedOpsetsPass()(model)
        tally["functions and opsets"] += declared - _count_declared(model)
        removed = ", ".join(f"{count} {what}" for what, count in tally.items() if count)
        notes = (f"removed: {removed}",) if removed else ()
        return PassResult(model, tally.total(), notes)

    def _round(self, body: ir.Graph, tally: Counter[str]) -> None:
        site = _MergeSite(body, self.name)
        tally["initializers"] += share_initializers(body)
        work = dict.fromkeys(reversed(list(body)))
        while work:
            node, _ = work.popitem()
            if node.graph is body:
                work.update(dict.fromkeys(self._simplify(node, site, tally)))
        tally["equal nodes"] += share_nodes(body, self.name)

    def _simplify(
        self, node: ir.Node, site: "_MergeSite", tally: Counter[str]
    ) -> list[ir.Node]:
        """Remove, bypass or merge a node; return those that may be simpler now."""
        if not any(is_read(value) for value in node.outputs):
            makers = list(node.predecessors())
            remove_node(node)
            tally["unread"] += 1
            return makers
        # A node that repeats its input is bypassed
        same = identity_of(node)
        if same is not None and bypass(node.outputs[0], same):
            remove_node(node)
            tally["identities"] += 1
            return [use.node for use in same.uses()]
        merged = merge(node, site)
        if merged is None:
            return []
        tally["merged pairs"] += 1
        return [merged, *merged.successors(), *merged.predecessors()]


def _count_declared(model: ir.Model) -> int:
    inner = sum(len(body.opset_imports) for body in model.functions.values())
    return len(model.functions) + len(model.opset_imports) + inner


# Merge nodes and initializers that are there twice.


COMMUTATIVE = frozenset({"Add", "And", "Equal", "Mul", "Or", "Xor"})


def share_nodes(graph: ir.Graph, by: str) -> int:
    """Merge equal nodes into the first of them and count the removed ones.

    Nodes of different modules stay apart, so that a module can be taken out later.
    """
    # Find equal nodes and bypass all but the first
    first: dict[object, ir.Node] = {}
    merged: dict[ir.Node, list[ir.Node]] = {}
    for node in graph:
        if not is_standard(node) or draws(node) or has_subgraph(node):
            continue
        module = provenance.module_of(node)
        inputs = [id(value) for value in node.inputs]
        if node.op_type in COMMUTATIVE:
            inputs.sort()
        named = tuple(bool(value.name) for value in node.outputs)
        values = attribute_values(node)
        key = (node.op_type, tuple(inputs), named, values, module)
        known = first.setdefault(key, node)
        if known is node:
            continue
        pairs = list(zip(node.outputs, known.outputs, strict=True))
        if all(can_replace(old, new) for old, new in pairs):
            for old, new in pairs:
                bypass(old, new)
            merged.setdefault(known, [known]).append(node)
    # Remove the duplicates; the first inherits their provenance
    for known, nodes in merged.items():
        provenance.inherit(known, nodes, by=by)
        graph.remove(nodes[1:], safe=True)
    return sum(len(nodes) - 1 for nodes in merged.values())


def share_initializers(graph: ir.Graph) -> int:
    """Merge equal initializers into the first and count the removed ones."""
    count, first = 0, dict[bytes, ir.Value]()
    for value in list(graph.initializers.values()):
        if value.const_value is None or value.is_graph_input():
            continue
        known = first.setdefault(digest_of_tensor(value.const_value), value)
        if known is not value and not value.is_graph_output():
            value.replace_all_uses_with(known)
            del graph.initializers[value.name or ""]
            count += 1
    return count


# Remove nodes that only repeat a value: a rule returns what the first output of a node
# equals, bit for bit, or None. Adding 0.0 is none of them: -0.0 + 0.0 is +0.0.


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


# Merge pairs of nodes: a rule rewrites the graph around a node and returns the node to
# visit next (the node itself, now unread, if it was removed), or None.


_RESHAPING = VIEWS - {"Identity"}


@dataclasses.dataclass
class _MergeSite:
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


def merge(node: ir.Node, site: _MergeSite) -> ir.Node | None:
    """Merge a node with the view or Transpose before it, if one node can do both."""
    inner = maker(node.inputs[0], "Transpose", *_RESHAPING) if node.inputs else None
    if inner is None or inner.graph is not node.graph or not is_standard(node):
        return None
    merged = _merge_views(node, inner, site)
    return merged or _merge_transposes(node, inner, site)


def _is_view(node: ir.Node) -> bool:
    transposes = node.op_type == "Transpose"
    return moves_nothing(node) if transposes else node.op_type in _RESHAPING


def _merge_views(node: ir.Node, inner: ir.Node, site: _MergeSite) -> ir.Node | None:
    """Merge consecutive Reshape, Flatten, Squeeze and Unsqueeze into one or none."""
    source, sizes = inner.inputs[0], static_shape(node.outputs[0])
    if source is None or sizes is None or 0 in sizes:
        return None
    if not _is_view(node) or not _is_view(inner):
        return None
    # Back to the shape before, or one Reshape in place of both
    if static_shape(source) == sizes and bypass(node.outputs[0], source):
        return node
    if sole_reader(inner.outputs[0]) is None:
        return None
    shape = site.shape(sizes, node)
    return put(node, "Reshape", [source, shape], by=site.by, sources=[inner])


def _merge_transposes(
    node: ir.Node, inner: ir.Node, site: _MergeSite
) -> ir.Node | None:
    """Merge consecutive Transposes into one or none."""
    if {node.op_type, inner.op_type} != {"Transpose"}:
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
