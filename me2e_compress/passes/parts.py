"""Parts of a graph: a module, or the scopes that a pattern matches."""

import dataclasses
import math
from typing import Self

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.graph import provenance
from me2e_compress.graph.modules import ModuleMap, PathGlob, scope_of
from me2e_compress.graph.modules.module_map import entering, leaving

_NAMED = 4
"""Number of values that a message lists."""


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
    """Return the shape from which ``have`` broadcasts to ``want``; None if none does.

    Whole queries are repeated: [1, 256] of an agent becomes [1, 1, 256] for six modes
    [1, 6, 256], and [1, A, 256] of all agents [1, A, 1, 256] for [1, A, 6, 256].
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
    """Drop dimensions of size 1: moving only these moves no element."""
    if math.prod(shape) == 0:
        return shape
    return tuple(size for size in shape if size != 1)


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
    if not sizes:
        return [()]
    return [
        (axis, *rest)
        for axis in range(start, len(want))
        if want[axis] == sizes[0]
        for rest in _places(sizes[1:], want, axis + 1)
    ]
