"""A piece of graph as an expression, and the search for it.

``x * Sigmoid(x)``::

    x = var("x")
    swish = op("Mul", x, op("Sigmoid", x))

An expression is matched from its last operator upwards. One object stands for one
value wherever it occurs, so the two ``x`` must be the same. Operands of commutative
operators match in either order. What an inner operator makes must be read inside the
expression alone, in the same graph, and be no output.
"""

import abc
import dataclasses
import itertools
from collections.abc import Iterator
from typing import TypeAlias

import numpy as np
import onnx_ir as ir

from me2e_compress.errors import GraphError
from me2e_compress.graph.nodes import (
    FLOATS,
    Array,
    Numbers,
    array_of,
    is_read,
    maker,
)

_IN_ANY_ORDER = frozenset(
    {"Add", "And", "Equal", "Max", "Mean", "Min", "Mul", "Or", "Sum", "Xor"}
)
"""The standard operators whose operands may change places, up to rounding."""


class Pattern(abc.ABC):
    """An expression that a value may match; compared by identity."""

    @abc.abstractmethod
    def ways(self, value: ir.Value) -> Iterator["Way"]:
        """Walk the ways in which a value may be this: what must match then."""

    def roots(self) -> frozenset[str]:
        """List the types of the operators that can end the expression.

        Raises:
            GraphError: it does not end in an operator, so nothing could be replaced.
        """
        raise GraphError(f"a fusion ends in an operator, not in {self}")


Goal: TypeAlias = tuple[Pattern, ir.Value]


@dataclasses.dataclass(frozen=True)
class Way:
    """What has to match besides, and the nodes that this takes in.

    Attributes:
        goals: the patterns of the operands, each with its value.
        nodes: the nodes taken in, the last one first.
        inner: the values that these nodes make for the expression alone.
    """

    goals: tuple[Goal, ...] = ()
    nodes: tuple[ir.Node, ...] = ()
    inner: tuple[ir.Value, ...] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class Variable(Pattern):
    """Any value; one that is computed, if asked."""

    name: str
    computed: bool = False

    def ways(self, value: ir.Value) -> Iterator[Way]:
        """Accept the value as it is."""
        if not (self.computed and array_of(value) is not None):
            yield Way()


@dataclasses.dataclass(frozen=True, eq=False)
class Constant(Pattern):
    """A weight, of one element if asked."""

    scalar: bool = False
    floating: bool = True

    def ways(self, value: ir.Value) -> Iterator[Way]:
        """Accept a weight whose type and size fit."""
        if self.floating and value.dtype not in FLOATS:
            return
        array = array_of(value)
        if array is not None and not (self.scalar and array.size != 1):
            yield Way()


@dataclasses.dataclass(frozen=True, eq=False)
class OperatorPattern(Pattern):
    """A node of one of some types, with operands that match."""

    types: tuple[str, ...]
    inputs: tuple[Pattern, ...] = ()
    more: bool = False

    def roots(self) -> frozenset[str]:
        """List its own types."""
        return frozenset(self.types)

    def ways(self, value: ir.Value) -> Iterator[Way]:
        """Look at the maker; try the operands in each order that means the same."""
        node = maker(value, *self.types)
        if node is None or value.index() != 0:
            return
        for operands in self._orders(node):
            goals = tuple(zip(self.inputs, operands, strict=True))
            yield Way(goals, (node,), (value,))

    def _orders(self, node: ir.Node) -> Iterator[tuple[ir.Value, ...]]:
        given = list(node.inputs)
        while given and given[-1] is None:
            given.pop()
        if self.more:
            given = given[: len(self.inputs)]
        operands = tuple(value for value in given if value is not None)
        if not len(operands) == len(given) == len(self.inputs):
            return
        if node.op_type in _IN_ANY_ORDER:
            yield from itertools.permutations(operands)
        else:
            yield operands


@dataclasses.dataclass(frozen=True, eq=False)
class Either(Pattern):
    """The first of some expressions that matches."""

    options: tuple[Pattern, ...]

    def roots(self) -> frozenset[str]:
        """Unite those of the options."""
        return frozenset().union(*(option.roots() for option in self.options))

    def ways(self, value: ir.Value) -> Iterator[Way]:
        """Try the options in order."""
        for option in self.options:
            yield Way(((option, value),))


def var(name: str, *, computed: bool = False) -> Variable:
    """Build the pattern of any value, or of any value that is not a constant."""
    return Variable(name, computed)


def constant(*, scalar: bool = False, floating: bool = True) -> Constant:
    """Build the pattern of a weight, of floats unless ``floating`` is False.

    ``scalar`` weights have one element.
    """
    return Constant(scalar, floating)


def op(
    types: str | tuple[str, ...], *inputs: Pattern, more: bool = False
) -> OperatorPattern:
    """Build the pattern of the first output of an operator, or of one of several.

    ``more`` operands may follow that the pattern does not look at.
    """
    names = (types,) if isinstance(types, str) else types
    return OperatorPattern(names, inputs, more)


def either(*options: Pattern) -> Either:
    """Build the pattern of one of several expressions, tried in this order."""
    return Either(options)


# The search for an expression in a graph.


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
        producer = self.values[part].producer()
        if producer is None:
            raise GraphError(f"no node makes {self.values[part].name}")
        return producer

    def array(self, part: Pattern) -> Array:
        """Return the array of a constant part, as it is stored.

        Raises:
            GraphError: it is not a constant.
        """
        constant = array_of(self.values[part])
        if constant is None:
            raise GraphError(f"{self.values[part].name} is not a constant")
        return constant

    def numbers(self, part: Pattern) -> Numbers:
        """Return the array of a constant part, widened to float64."""
        return self.array(part).astype(np.float64)


def match(pattern: Pattern, node: ir.Node) -> Match | None:
    """Find an expression that ends in a node; None if none does."""
    if any(is_read(value) for value in node.outputs[1:]):
        return None
    return _solve(((pattern, node.outputs[0]),), Match(node, (), {}), ())


def _solve(
    goals: tuple[Goal, ...], match: Match, inner: tuple[ir.Value, ...]
) -> Match | None:
    """Match the first goal in each of its ways until the rest matches too."""
    if not goals:
        # Nothing else may read what the inner nodes make
        last = match.root.outputs[0]
        closed = all(value is last or _is_inside(value, match) for value in inner)
        return match if closed else None
    (pattern, value), rest = goals[0], goals[1:]
    if pattern in match.values:
        if match.values[pattern] is not value:
            return None
        return _solve(rest, match, inner)
    values = {**match.values, pattern: value}
    for way in pattern.ways(value):
        taken = tuple(dict.fromkeys((*match.nodes, *way.nodes)))
        solved = _solve(
            way.goals + rest, Match(match.root, taken, values), inner + way.inner
        )
        if solved is not None:
            return solved
    return None


def _is_inside(value: ir.Value, match: Match) -> bool:
    node = value.producer()
    return (
        node is not None
        and node.graph is match.root.graph
        and not value.is_graph_output()
        and not any(is_read(other) for other in node.outputs[1:])
        and all(reader in match.nodes for reader in value.consumers())
    )
