"""Add edges to a graph: a part reads another's result, without weights."""

import dataclasses
import itertools
import math
from collections.abc import Callable
from typing import Literal

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.errors import PreconditionError, RecipeError
from me2e_compress.graph import rewrite
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.graph.nodes import makers_of
from me2e_compress.graph.shapes import REFUSALS, infer_node
from me2e_compress.operators import FusedCall
from me2e_compress.passes.parts import (
    Part,
    fit,
    listed,
    shaped_like,
    stretched,
    writer_for,
)


def propagate_size(model: ir.Model, grown: ir.Value, old: ir.Value, what: str) -> None:
    """Infer the shapes behind a value that grew along one axis, in place.

    A Reshape gets a new constant shape. Raises PreconditionError where an operator or a
    graph output does not take the new size. ``what`` describes the change in messages.
    """
    # Visit, in order, only nodes that read a grown value
    was = {grown: graph.static_shape(old) or ()}
    for node in model.graph:
        if not any(value in was for value in node.inputs if value is not None):
            continue
        if node.op_type == "Reshape":
            _reshape(model.graph, node, was, what)
        cause: Exception | None = None
        try:
            kinds = infer_node(node, graph.opset_of(model))
        except REFUSALS as error:
            kinds, cause = {}, error
        if not kinds:
            read = listed([value for value in node.inputs if value is not None])
            raise PreconditionError(
                f"{what} does not fit {node.name} ({node.op_type}), which reads {read}"
            ) from cause
        for value in node.outputs:
            # A shape may change only where it stays known and internal
            _, shape = kinds.get(value, (None, None))
            after = shape.numpy() if shape is not None and shape.is_static() else None
            before = graph.static_shape(value)
            if before == after or not value.name:
                continue
            if after is None or before is None or value.is_graph_output():
                raise PreconditionError(f"{what} would change {listed([value])}")
            was[value], value.shape = before, ir.Shape(after)


def _reshape(
    where: ir.Graph, node: ir.Node, was: dict[ir.Value, tuple[int, ...]], what: str
) -> None:
    """Update a constant shape; the grown axis must be neither split nor merged."""
    # The shapes before and after must be known
    source, size = node.inputs[0], node.inputs[1]
    made = graph.static_shape(node.outputs[0])
    target = None if size is None else graph.array_of(size)
    after = graph.static_shape(source)
    if source is None or made is None or target is None or after is None:
        raise PreconditionError(
            f"{what}: the shape that {node.name} makes is not known"
        )
    before = was[source]
    # Find the same axis in the target shape
    axis = next(at for at, size in enumerate(before) if size != after[at])
    places = [
        at
        for at, length in enumerate(made)
        if length == before[axis] and math.prod(made[:at]) == math.prod(before[:axis])
    ]
    if not places:
        raise PreconditionError(
            f"{what} does not fit {node.name}, which makes {list(made)} of"
            f" {list(before)}: the queries are no axis of that"
        )
    shape = np.array(made, np.int64)
    shape[places[0]] = after[axis]
    name = f"{node.outputs[0].name}_shape"
    node.replace_input_with(1, rewrite.add_constant(where, shape, name))


@dataclasses.dataclass(frozen=True)
class Edge:
    """An edge through which one part of a graph reads another's result directly.

    Given:   map -> motion -> planner

    Result:  map -> motion -> planner, map -> planner

    A part is a module of the map (``track``) or a pattern of scopes
    (``*.ego_map_decoder``).

    Attributes:
        source: the part whose result is read: among the fitting values that leave it,
            one that the reader reads already, or else the last.
        reader: the part that reads it, joined to one of the values that enter it: the
            largest that fits; on a tie, the one that is first read last.
        how: ``append`` appends the source's queries to the reader's; ``add`` adds them;
            ``replace`` replaces them. The last two repeat a result of fewer queries:
            one agent's for its six modes.
        of: the part that makes the value that the reader reads so far; None: any.
        axis: the axis of the queries, for ``append``.

    Raises:
        RecipeError: ``how="replace"`` without ``of``.
    """

    source: str
    reader: str
    how: Literal["append", "add", "replace"] = "append"
    of: str | None = None
    axis: int = 1

    def __post_init__(self) -> None:
        """Check that ``replace`` names what it replaces."""
        if self.how == "replace" and self.of is None:
            raise RecipeError(f"edge {self.label}: how=replace needs of=PART too")

    @property
    def label(self) -> str:
        """Source and reader, for messages."""
        return f"{self.source} -> {self.reader}"


def add_edge(
    model: ir.Model,
    edge: Edge,
    modules: ModuleMap,
    goes: Callable[[ir.Node | None], bool],
    by: str,
) -> str:
    """Add an edge to a sorted graph with scopes and shapes; return a description.

    The graph changes only downstream of the reader; ``goes`` tells removed nodes.

    Raises:
        PreconditionError: a part is missing, there would be a cycle, or nothing fits.
    """
    # Find both ends; a cycle is refused
    source, reader = Part.of(edge.source, modules), Part.of(edge.reader, modules)
    new, old = _ends(model, edge, source, reader, modules, goes)
    readers = [node for node in old.consumers() if reader.holds(node)]
    if not makers_of([new]).keys().isdisjoint(readers):
        raise PreconditionError(
            f"edge {edge.label}: {new.name} depends on what {edge.reader} makes of"
            f" {old.name}"
        )
    # Redirect only the readers inside the reading part
    uses = [(node, index) for node, index in old.uses() if node in readers]
    joined = _join(writer_for(model, readers, by), edge, new, old)
    for node, index in uses:
        node.replace_input_with(index, joined)
    model.graph.sort()
    if edge.how == "append":
        propagate_size(model, joined, old, f"edge {edge.label}: {listed([new])}")
    how = {"append": "behind", "add": "added to", "replace": "in the place of"}
    return f"{edge.reader} reads {listed([new])} {how[edge.how]} {listed([old])}"


def _ends(
    model: ir.Model,
    edge: Edge,
    source: Part,
    reader: Part,
    modules: ModuleMap,
    goes: Callable[[ir.Node | None], bool],
) -> tuple[ir.Value, ir.Value]:
    """Find the value to read, and the one that it joins or replaces."""
    # Both parts must exist and exchange values
    made_by = [node for node in model.graph if source.holds(node)]
    if all(map(goes, made_by)):
        dropped, lacking = "{} is dropped too", "the graph has no {}"
        reason = (dropped if made_by else lacking).format(source.name)
        raise PreconditionError(f"edge {edge.label}: {reason}")
    read = reader.entries(model)
    left = [v for v in source.exits(model) if not goes(v.producer())]
    if not read or not left:
        what = f"{edge.reader} reads" if left else f"{edge.source} gives"
        raise PreconditionError(f"edge {edge.label}: {what} nothing")
    # Restrict the reader's inputs to those that ``of`` makes
    made = [value for value in read if not source.holds(value.producer())]
    if edge.of is not None:
        of = Part.of(edge.of, modules)
        made = [value for value in made if of.holds(value.producer())]
    if not made:
        raise PreconditionError(
            f"edge {edge.label}: {edge.reader} reads nothing of {edge.of or 'others'},"
            f" only {listed(read)}"
        )
    # Rank all fitting pairs; the largest input wins
    ranked = [
        (math.prod(graph.static_shape(old) or ()), old_at, best, new in read, new_at)
        for (old_at, old), (new_at, new) in itertools.product(
            enumerate(made), enumerate(left)
        )
        if (best := _fit(edge, new, old))
    ]
    if not ranked:
        raise PreconditionError(
            f"edge {edge.label}: nothing that leaves {edge.source} ({listed(left)})"
            f" fits what {edge.reader} reads ({listed(made)})"
        )
    _, old_at, _, _, new_at = max(ranked)
    return left[new_at], made[old_at]


def _fit(edge: Edge, new: ir.Value, old: ir.Value) -> int:
    """Return how well two values can be joined; 0 means not at all."""
    if edge.how != "append":
        return fit(new, old)
    have, want = _as_queries(new, old), graph.static_shape(old)
    if have is None or want is None or new.dtype != old.dtype:
        return 0
    # All other axes must agree
    axis = edge.axis
    if not -len(want) <= axis < len(want) or want[axis] < 2:
        return 0
    others = [at for at in range(len(want)) if at != axis % len(want)]
    return int(all(have[at] == want[at] for at in others))


def _as_queries(new: ir.Value, old: ir.Value) -> tuple[int, ...] | None:
    have, want = graph.static_shape(new), graph.static_shape(old)
    if have is None or want is None or len(have) > len(want):
        return None
    return (1,) * (len(want) - len(have)) + have


def _join(call: FusedCall, edge: Edge, new: ir.Value, old: ir.Value) -> ir.Value:
    if edge.how == "replace":
        return shaped_like(call, new, old)
    if edge.how == "add":
        want = graph.static_shape(old) or ()
        padded = stretched(graph.static_shape(new) or (), want) or want
        return call.add("Add", [old, call.view(new, padded)])
    padded = _as_queries(new, old) or ()
    return call.add("Concat", [old, call.view(new, padded)], {"axis": edge.axis})
