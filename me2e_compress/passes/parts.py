"""Parts of a graph (a module, or scopes), and what replaces their values."""

import dataclasses
from collections.abc import Sequence
from typing import Self

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.display import plural
from me2e_compress.base.errors import FramesError, PreconditionError
from me2e_compress.calibration.means import token_means
from me2e_compress.graph import provenance
from me2e_compress.graph.modules.module_map import (
    ModuleMap,
    PathGlob,
    entering,
    leaving,
    scope_of,
)
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
    places = _places(without_ones(have), want)
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


def _places(
    sizes: tuple[int, ...], want: tuple[int, ...], start: int = 0
) -> list[tuple[int, ...]]:
    """Return all axes of a shape that have these sizes, in this order."""
    if not sizes:
        return [()]
    return [
        (axis, *rest)
        for axis in range(start, len(want))
        if want[axis] == sizes[0]
        for rest in _places(sizes[1:], want, axis + 1)
    ]


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
    waiting, seen = [value], set[ir.Value]()
    while waiting:
        current = waiting.pop()
        if current.is_graph_input() or current.dtype not in _INTEGERS:
            return False
        seen.add(current)
        producer = current.producer()
        if producer is not None and producer.op_type not in ("Shape", "Size"):
            waiting += {v for v in producer.inputs if v is not None} - seen
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
