"""Parts of a graph (modules, scopes): what replaces their values, and edges."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Literal, Self

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.display import plural
from me2e_compress.base.errors import FramesError, PreconditionError, RecipeError
from me2e_compress.calibration.means import token_means
from me2e_compress.graph import provenance, rewrite
from me2e_compress.graph.modules.module_map import (
    ModuleMap,
    PathGlob,
    entering,
    leaving,
    scope_of,
)
from me2e_compress.graph.nodes import makers_of
from me2e_compress.graph.shapes import REFUSALS, infer_node
from me2e_compress.operators import FusedCall
from me2e_compress.passes.base import Context
from me2e_compress.runtime.frames import Array

# Number of values that a message lists.
_NAMED = 4

_INTEGERS = (ir.DataType.INT64, ir.DataType.INT32, ir.DataType.BOOL)


@dataclasses.dataclass(frozen=True)
class Part:
    """A module of the map by its name, or the scopes that a pattern matches."""

    name: str
    is_module: bool = False

    @classmethod
    def of(cls, name: str, modules: ModuleMap) -> Self:
        """Read a name; that of a module takes precedence over a pattern."""
        return cls(name, name in modules.names())

    def holds(self, node: ir.Node | None) -> bool:
        """Return whether a node belongs to this part."""
        if node is None:
            return False
        if self.is_module:
            return provenance.module_of(node) == self.name
        return within(node, self.name)

    def exits(self, model: ir.Model) -> tuple[ir.Value, ...]:
        """Return the values that leave it, in graph order."""
        return leaving(model, self.holds)

    def entries(self, model: ir.Model) -> tuple[ir.Value, ...]:
        """Return the values that enter it, in the order they are first read."""
        return entering(model, self.holds)


def within(node: ir.Node, scope: str) -> bool:
    """Return whether a node was made in a scope such as ``*.lane_encoder``."""
    path = tuple(part for part in scope_of(node).split(".") if part)
    return PathGlob(scope).reach(path) is not None


def listed(values: tuple[ir.Value, ...] | list[ir.Value]) -> str:
    """Name values with their shapes, for a message."""
    names = [f"{value.name} {value.shape}" for value in values[-_NAMED:]]
    more = f"{len(values) - _NAMED} more, " if len(values) > _NAMED else ""
    return more + ", ".join(names)


def stretched(have: tuple[int, ...], want: tuple[int, ...]) -> tuple[int, ...] | None:
    """Return ``have`` with axes of size 1 inserted so that it broadcasts to ``want``.

    Whole queries are repeated: [1, 256] of an agent becomes [1, 1, 256] for six modes
    [1, 6, 256], and [1, A, 256] of all agents [1, A, 1, 256] for [1, A, 6, 256]. None
    where there is no such shape, or more than one.
    """
    if have == want or without_ones(have) == without_ones(want):
        return want
    if not have or not want or have[-1] != want[-1] or len(have) > len(want):
        return None
    padded = (1,) * (len(want) - len(have)) + have
    if all(one in (1, full) for one, full in zip(padded, want, strict=True)):
        return padded
    # All axes that have these sizes, in this order
    sizes = without_ones(have)
    places = [
        axes
        for axes in itertools.combinations(range(len(want)), len(sizes))
        if tuple(want[axis] for axis in axes) == sizes
    ]
    if len(places) != 1:  # none, or several
        return None
    return tuple(size if axis in places[0] else 1 for axis, size in enumerate(want))


def without_ones(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Drop dimensions of size 1, unless the shape is empty: they move no element."""
    return tuple(size for size in shape if size != 1 or 0 in shape)


def fit(value: ir.Value, like: ir.Value) -> int:
    """Return 2 if a value can replace another, 1 after a broadcast, else 0."""
    have, want = graph.static_shape(value), graph.static_shape(like)
    if have is None or want is None or value.dtype != like.dtype:
        return 0
    padded = stretched(have, want)
    return 0 if padded is None else 1 + (padded == want)


def module_of(value: ir.Value) -> str:
    """Return the module that makes a value; empty for inputs and initializers."""
    producer = value.producer()
    return "" if producer is None else provenance.module_of(producer)


def result_of(model: ir.Model, part: Part, like: ir.Value | None = None) -> ir.Value:
    """Return the last value that leaves a part, with ``like`` the last that fits it.

    A decoder returns its queries and, last, the reference points it refined. Raises
    PreconditionError if there is none.
    """
    values = part.exits(model)
    if not values:
        raise PreconditionError(f"no value leaves a scope {part.name} in this graph")
    if like is None:
        return values[-1]
    # Prefer the best fit, then the last value
    best, index = max((fit(value, like), index) for index, value in enumerate(values))
    if not best:
        raise PreconditionError(
            f"nothing that leaves {part.name} fits {like.name} {like.shape}:"
            f" {listed(values)}"
        )
    return values[index]


def is_shape_arithmetic(value: ir.Value) -> bool:
    """Return whether integers come only from shapes and constants, not from data."""
    waiting, visited = [value], set[ir.Value]()
    while waiting:
        current = waiting.pop()
        if current.is_graph_input() or current.dtype not in _INTEGERS:
            return False
        visited.add(current)
        producer = current.producer()
        if producer is not None and producer.op_type not in ("Shape", "Size"):
            waiting += {v for v in producer.inputs if v is not None} - visited
    return True


def replace_readers(old: ir.Value, new: ir.Value) -> None:
    """Replace a value in the nodes that read it, but not as a graph output."""
    maker = new.producer()
    for node, index in tuple(old.uses()):
        if node is not maker:
            node.replace_input_with(index, new)


def layout_of(value: ir.Value) -> tuple[tuple[int, ...], np.dtype[np.generic]]:
    """Return the shape and type of a substitute; shape arithmetic has none."""
    if is_shape_arithmetic(value):
        raise PreconditionError(
            f"{value.name} is arithmetic on shapes, which no module owns: run"
            " fold-constants first"
        )
    shape = graph.static_shape(value)
    if shape is None or value.dtype is None:
        raise PreconditionError(
            f"{value.name} has shape {value.shape}: zeros or a mean need a static one,"
            " run fold-constants first"
        )
    return shape, value.dtype.numpy()


def writer_for(model: ir.Model, readers: Sequence[ir.Node], by: str) -> FusedCall:
    """Return a writer of nodes for some readers; sort the graph after it was used."""
    present = (node for node in readers if node.graph is model.graph)
    place = next(present, model.graph[-1])
    call = FusedCall(place, opset=graph.opset_of(model), by=by)
    call.sources = tuple(readers)
    return call


def zeros_like(call: FusedCall, value: ir.Value) -> ir.Value:
    """Write zeros of a value's shape and type, in a few bytes of any size."""
    shape, _ = layout_of(value)
    return call.full(shape, 0.0, value)


def shaped_like(call: FusedCall, new: ir.Value, old: ir.Value) -> ir.Value:
    """Give ``new`` the shape of ``old``: add ones, repeat along axes of size 1.

    It must fit, see :func:`fit`.
    """
    have, want = graph.static_shape(new), graph.static_shape(old)
    padded = have and want and stretched(have, want)
    if not padded or not want:
        return new
    shaped = call.view(new, padded)
    same = padded == want
    return shaped if same else call.add("Expand", [shaped, call.integers(want)])


def means_of(
    model: ir.Model, values: Sequence[ir.Value], context: Context
) -> tuple[dict[str, Array], str]:
    """Measure means by value name; also name their source.

    Raises:
        FramesError: no frames, or they are of another graph.
    """
    for value in values:
        layout_of(value)
    names = [str(value.name) for value in values]
    frames = context.frames
    if frames is None:
        raise FramesError(
            "fill=means needs recorded frames (--frames): a mean is never made up"
        )
    means = token_means(model, frames, names, provider=context.provider)
    return means, f"its mean over {plural(len(frames), 'frame')}"


# Add edges: a part reads another's result, without weights.


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
    have, want = graph.static_shape(new), graph.static_shape(old)
    if have is None or want is None or new.dtype != old.dtype or len(have) > len(want):
        return 0
    have = (1,) * (len(want) - len(have)) + have
    # All other axes must agree
    axis = edge.axis
    if not -len(want) <= axis < len(want) or want[axis] < 2:
        return 0
    others = [at for at in range(len(want)) if at != axis % len(want)]
    return int(all(have[at] == want[at] for at in others))


def _join(call: FusedCall, edge: Edge, new: ir.Value, old: ir.Value) -> ir.Value:
    if edge.how == "replace":
        return shaped_like(call, new, old)
    have, want = graph.static_shape(new) or (), graph.static_shape(old) or ()
    if edge.how == "add":
        return call.add("Add", [old, call.view(new, stretched(have, want) or want)])
    queries = call.view(new, (1,) * (len(want) - len(have)) + have)
    return call.add("Concat", [old, queries], {"axis": edge.axis})
