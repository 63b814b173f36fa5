"""Patterns of operators, and their search in a graph.

``x * Sigmoid(x)``::

    x = var("x")
    swish = op("Mul", x, op("Sigmoid", x))

A pattern is matched from its last operator upwards. One object stands for one value
wherever it occurs, so the two ``x`` must be the same. Operands of commutative operators
match in any order. Values of inner operators may be read only inside the pattern and in
the same graph, and may not be graph outputs.
"""

import abc
import dataclasses
import itertools
from collections.abc import Iterator
from typing import TypeAlias

import numpy as np
import onnx_ir as ir

from me2e_compress.base.errors import GraphError
from me2e_compress.graph.nodes import FLOATS, Array, Numbers, array_of, is_read, maker

# The standard operators whose operands may be swapped, up to rounding
_IN_ANY_ORDER = frozenset(
    {"Add", "And", "Equal", "Max", "Mean", "Min", "Mul", "Or", "Sum", "Xor"}
)


class Pattern(abc.ABC):
    """A pattern that a value may match; compared by identity."""

    @abc.abstractmethod
    def ways(self, value: ir.Value) -> Iterator["Way"]:
        """Yield the ways in which a value may match, with what must match then."""

    def roots(self) -> frozenset[str]:
        """Return the types of operators that can end the pattern; else a GraphError."""
        raise GraphError(f"a fusion ends in an operator, not in {self}")


Goal: TypeAlias = tuple[Pattern, ir.Value]


@dataclasses.dataclass(frozen=True)
class Way:
    """One way to match a value.

    Attributes:
        goals: the patterns of the operands, with the values that must match them.
        nodes: the matched nodes, the last one first.
    """

    goals: tuple[Goal, ...] = ()
    nodes: tuple[ir.Node, ...] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class Variable(Pattern):
    """Any value; with ``computed``, any that is not a constant."""

    name: str
    computed: bool = False

    def ways(self, value: ir.Value) -> Iterator[Way]:
        """Match the value itself."""
        if not (self.computed and array_of(value) is not None):
            yield Way()


@dataclasses.dataclass(frozen=True, eq=False)
class Constant(Pattern):
    """A constant; with ``scalar``, of one element; with ``floating``, of floats."""

    scalar: bool = False
    floating: bool = True

    def ways(self, value: ir.Value) -> Iterator[Way]:
        """Match a constant whose type and size fit."""
        if self.floating and value.dtype not in FLOATS:
            return
        array = array_of(value)
        if array is not None and not (self.scalar and array.size != 1):
            yield Way()


@dataclasses.dataclass(frozen=True, eq=False)
class OperatorPattern(Pattern):
    """A node of one of some types whose operands match; ``more`` may follow them."""

    types: tuple[str, ...]
    inputs: tuple[Pattern, ...] = ()
    more: bool = False

    def roots(self) -> frozenset[str]:
        """Return its own types."""
        return frozenset(self.types)

    def ways(self, value: ir.Value) -> Iterator[Way]:
        """Match the maker of the value, with its operands in all equivalent orders."""
        node = maker(value, *self.types)
        if node is None or value.index() != 0:
            return
        for operands in self._orders(node):
            yield Way(tuple(zip(self.inputs, operands, strict=True)), (node,))

    def _orders(self, node: ir.Node) -> Iterator[tuple[ir.Value, ...]]:
        inputs = list(node.inputs)
        while inputs and inputs[-1] is None:
            inputs.pop()
        if self.more:
            inputs = inputs[: len(self.inputs)]
        operands = tuple(value for value in inputs if value is not None)
        if not len(operands) == len(inputs) == len(self.inputs):
            return
        any_order = node.op_type in _IN_ANY_ORDER
        yield from itertools.permutations(operands) if any_order else [operands]


@dataclasses.dataclass(frozen=True, eq=False)
class Either(Pattern):
    """The first of several patterns that matches."""

    options: tuple[Pattern, ...]

    def roots(self) -> frozenset[str]:
        """Return those of all options."""
        return frozenset().union(*(option.roots() for option in self.options))

    def ways(self, value: ir.Value) -> Iterator[Way]:
        """Try the options in order."""
        for option in self.options:
            yield Way(((option, value),))


# The words in which patterns are written
var, constant = Variable, Constant


def op(
    types: str | tuple[str, ...], *inputs: Pattern, more: bool = False
) -> OperatorPattern:
    """Build the pattern of an operator's first output; ``more`` operands may follow."""
    names = (types,) if isinstance(types, str) else types
    return OperatorPattern(names, inputs, more)


def either(*options: Pattern) -> Either:
    """Build the pattern of the first of several patterns that matches."""
    return Either(options)


@dataclasses.dataclass(frozen=True)
class Match:
    """The nodes and values that match a pattern.

    Attributes:
        root: the last node.
        nodes: all matched nodes, the root first.
        values: the matched value of every part of the pattern.
    """

    root: ir.Node
    nodes: tuple[ir.Node, ...]
    values: dict[Pattern, ir.Value]

    def __getitem__(self, part: Pattern) -> ir.Value:
        """Return the value that matched a part."""
        return self.values[part]

    def __contains__(self, part: Pattern) -> bool:
        """Return whether a part matched; of alternatives, only one does."""
        return part in self.values

    def node(self, part: Pattern) -> ir.Node:
        """Return the node that makes the value of a part; a GraphError if none does."""
        producer = self.values[part].producer()
        if producer is None:
            raise GraphError(f"no node makes {self.values[part].name}")
        return producer

    def array(self, part: Pattern) -> Array:
        """Return the array of a constant part, as it is stored; else a GraphError."""
        constant = array_of(self.values[part])
        if constant is None:
            raise GraphError(f"{self.values[part].name} is not a constant")
        return constant

    def numbers(self, part: Pattern) -> Numbers:
        """Return the array of a constant part, widened to float64."""
        return self.array(part).astype(np.float64)


def match(pattern: Pattern, node: ir.Node) -> Match | None:
    """Match a pattern that ends in a node; None if it does not match."""
    if any(is_read(value) for value in node.outputs[1:]):
        return None
    return _solve(((pattern, node.outputs[0]),), Match(node, (), {}))


def _solve(goals: tuple[Goal, ...], match: Match) -> Match | None:
    """Match the first goal in all its ways until the other goals match too."""
    if not goals:
        # No other node may read what inner nodes make
        inner = [node for node in match.nodes if node is not match.root]
        return match if all(_is_inside(node, match) for node in inner) else None
    (pattern, value), rest = goals[0], goals[1:]
    if pattern in match.values:
        return _solve(rest, match) if match.values[pattern] is value else None
    values = {**match.values, pattern: value}
    for way in pattern.ways(value):
        nodes = tuple(dict.fromkeys((*match.nodes, *way.nodes)))
        solved = _solve(way.goals + rest, Match(match.root, nodes, values))
        if solved is not None:
            return solved
    return None


def _is_inside(node: ir.Node, match: Match) -> bool:
    result = node.outputs[0]
    return (
        node.graph is match.root.graph
        and not result.is_graph_output()
        and not any(is_read(other) for other in node.outputs[1:])
        and all(reader in match.nodes for reader in result.consumers())
    )
