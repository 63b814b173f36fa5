"""The search for an expression in a graph."""

import dataclasses

import numpy as np
import onnx_ir as ir

from me2e_compress.errors import GraphError
from me2e_compress.graph import array_of
from me2e_compress.graph.nodes import Array, Numbers, is_read
from me2e_compress.graph.rewrite.pattern import Goal, Pattern


@dataclasses.dataclass(frozen=True)
class Match:
    """Where an expression was found.

    Attributes:
        root: the last node.
        nodes: every node of it, the root first.
        values: what stands for each part of the expression.
    """

    root: ir.Node
    nodes: tuple[ir.Node, ...]
    values: dict[Pattern, ir.Value]

    def __getitem__(self, part: Pattern) -> ir.Value:
        """Return the value that a part of the expression stands for."""
        return self.values[part]

    def __contains__(self, part: Pattern) -> bool:
        """Return whether the match took this part, of several that it could."""
        return part in self.values

    def node(self, part: Pattern) -> ir.Node:
        """Return the node that makes what a part stands for.

        Raises:
            GraphError: nothing makes it, it is an input or a weight.
        """
        found = self.values[part].producer()
        if found is None:
            raise GraphError(f"no node makes {self.values[part].name}")
        return found

    def array(self, part: Pattern) -> Array:
        """Return the array of a constant part, as it is stored.

        Raises:
            GraphError: it is not a constant.
        """
        found = array_of(self.values[part])
        if found is None:
            raise GraphError(f"{self.values[part].name} is not a constant")
        return found

    def numbers(self, part: Pattern) -> Numbers:
        """Return the array of a constant part, widened to float64."""
        return self.array(part).astype(np.float64)


def match(pattern: Pattern, node: ir.Node) -> Match | None:
    """Find an expression that ends in a node; None if none does."""
    if any(is_read(value) for value in node.outputs[1:]):
        return None
    return _solve(((pattern, node.outputs[0]),), Match(node, (), {}), ())


def _solve(
    goals: tuple[Goal, ...], found: Match, inner: tuple[ir.Value, ...]
) -> Match | None:
    """Match the first goal in each of its ways until the rest matches too."""
    if not goals:
        return found if _is_closed(found, inner) else None
    (pattern, value), rest = goals[0], goals[1:]
    if pattern in found.values:
        if not pattern.agree(found.values[pattern], value):
            return None
        return _solve(rest, found, inner)
    values = {**found.values, pattern: value}
    for way in pattern.ways(value):
        taken = tuple(dict.fromkeys((*found.nodes, *way.nodes)))
        solved = _solve(
            way.goals + rest, Match(found.root, taken, values), inner + way.inner
        )
        if solved is not None:
            return solved
    return None


def _is_closed(found: Match, inner: tuple[ir.Value, ...]) -> bool:
    """Check that nothing else reads what the inner nodes make."""
    return all(
        value is found.root.outputs[0] or _is_inside(value, found) for value in inner
    )


def _is_inside(value: ir.Value, found: Match) -> bool:
    maker = value.producer()
    return (
        maker is not None
        and maker.graph is found.root.graph
        and not value.is_graph_output()
        and not any(is_read(other) for other in maker.outputs[1:])
        and all(reader in found.nodes for reader in value.consumers())
    )
