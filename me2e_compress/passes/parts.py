"""Parts of a graph that a re-wiring names: a module, or the scopes of a pattern."""

import dataclasses
import math
from typing import Self

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.graph import provenance
from me2e_compress.modules import ModuleMap, PathGlob, scope_of
from me2e_compress.modules.paths import entering, leaving

_NAMED = 4
"""Values that a message lists."""


@dataclasses.dataclass(frozen=True)
class Part:
    """A module of the map, by its name, or the scopes that a pattern matches.

    Attributes:
        name: of the module (``track``), or the pattern (``*.ego_map_decoder``).
        is_module: which of the two it is.
    """

    name: str
    is_module: bool = False

    @classmethod
    def of(cls, name: str, modules: ModuleMap) -> Self:
        """Read a name: that of a module goes before a pattern."""
        return cls(name, name in modules.names())

    def holds(self, node: ir.Node | None) -> bool:
        """Return whether a node is of this part."""
        if node is None:
            return False
        if self.is_module:
            return provenance.module_of(node) == self.name
        return within(node, self.name)

    def exits(self, model: ir.Model) -> tuple[ir.Value, ...]:
        """List what it gives to the rest of the graph, in graph order."""
        return leaving(model, self.holds)

    def entries(self, model: ir.Model) -> tuple[ir.Value, ...]:
        """List what it reads of the rest of the graph, as it is first read."""
        return entering(model, self.holds)


def within(node: ir.Node, scope: str) -> bool:
    """Return whether a node was made in a scope, e.g. ``*.lane_encoder``."""
    path = tuple(part for part in scope_of(node).split(".") if part)
    return PathGlob(scope).reach(path) is not None


def listed(values: tuple[ir.Value, ...] | list[ir.Value]) -> str:
    """Name values with their shapes, for a message."""
    names = [f"{value.name} {value.shape}" for value in values[-_NAMED:]]
    more = f"{len(values) - _NAMED} more, " if len(values) > _NAMED else ""
    return more + ", ".join(names)


def stretched(have: tuple[int, ...], want: tuple[int, ...]) -> tuple[int, ...] | None:
    """Return the shape from which a broadcast makes another one; None if none does.

    The last axis, the channels, is as long in both: whole queries are repeated. One
    agent's [1, 256] is [1, 1, 256] for the six modes of [1, 6, 256], and [1, A, 256] of
    all agents is [1, A, 1, 256] for [1, A, 6, 256].

    Args:
        have: the shape of what is to be read.
        want: the shape of what is read so far.
    """
    if have == want or bare(have) == bare(want):
        return want
    if not have or not want or have[-1] != want[-1] or len(have) > len(want):
        return None
    padded = (1,) * (len(want) - len(have)) + have
    if all(one in (1, full) for one, full in zip(padded, want, strict=True)):
        return padded
    places = _places(bare(have), want)
    if len(places) != 1:  # none, or it could be meant in more ways than one
        return None
    return tuple(size if axis in places[0] else 1 for axis, size in enumerate(want))


def bare(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Drop the ones: a reorder that moves only those moves no element."""
    if math.prod(shape) == 0:
        return shape
    return tuple(size for size in shape if size != 1)


def fit(value: ir.Value, like: ir.Value) -> int:
    """Return how well a value can be read in another's place.

    Returns:
        2 as it is, up to dimensions of size 1; 1 after a broadcast; 0 not at all.
    """
    have, want = graph.static_shape(value), graph.static_shape(like)
    if have is None or want is None or value.dtype != like.dtype:
        return 0
    padded = stretched(have, want)
    return 0 if padded is None else 1 + (padded == want)


def _places(
    sizes: tuple[int, ...], want: tuple[int, ...], start: int = 0
) -> list[tuple[int, ...]]:
    """List the ways in which sizes stand, in their order, among those of a shape."""
    if not sizes:
        return [()]
    return [
        (axis, *rest)
        for axis in range(start, len(want))
        if want[axis] == sizes[0]
        for rest in _places(sizes[1:], want, axis + 1)
    ]
