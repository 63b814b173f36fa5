"""Choose which constant values become weights and which stay computed.

Folding removes nodes but may add bytes: a table repeated for every token is one node
and megabytes. A group of connected expressions is folded if it adds at most so many
bytes for each of its nodes:

    bytes stored - bytes of weights that nothing reads any more  <=  limit * nodes

If it adds more, its largest value is computed in every frame, and the rest is grouped
and asked again. A group that shrinks the weights always goes.
"""

import dataclasses
import math
from collections.abc import Container, Iterable

import onnx_ir as ir

from me2e_compress.graph.activations import value_bytes
from me2e_compress.passes.fold_constants.evaluation import Expression, Knowledge

ENTRY_BYTES = 64
"""Bytes of an initializer in the file besides its data: name, shape, type."""


@dataclasses.dataclass
class FoldChoice:
    """Which values become initializers, and which expressions are no longer needed.

    ``kept`` counts the nodes that go on computing constants because that is smaller.
    """

    values: list[ir.Value]
    gone: list[Expression]
    kept: int
    growth_bytes: int


def choose(known: Knowledge, bytes_per_node: int) -> FoldChoice:
    """Choose for every constant value whether it is stored or computed."""
    sizes = _Sizes(known)
    gone: set[Expression] = set()
    waiting = sizes.groups(known.expressions)
    while waiting:
        group = waiting.pop()
        nodes = sum(len(one.nodes) for one in group)
        if sizes.growth(group) <= bytes_per_node * nodes:
            gone.update(group)
        else:
            waiting.extend(sizes.groups(sizes.without_largest(group)))
    # Store what remaining nodes still read
    chosen = [one for one in known.expressions if one in gone]
    values = sizes.stored(chosen, gone)
    kept = sum(len(one.nodes) for one in known.expressions if one not in gone)
    return FoldChoice(values, chosen, kept, int(sizes.growth(chosen)))


class _Sizes:
    """Sizes of the values of one graph, and who reads them."""

    def __init__(self, known: Knowledge) -> None:
        self.known = known
        self.readers: dict[ir.Value, dict[Expression, None]] = {}
        for one in known.expressions:
            for value in one.inputs:
                if value is not None:
                    self.readers.setdefault(value, {})[one] = None
        # Values that nodes outside of constant expressions read
        self.outside = {
            value
            for one in known.expressions
            for place, value in enumerate(one.nodes[0].outputs)
            if self._is_read_outside(one, place)
        }
        # Weights that only constant expressions read
        self.weights = {
            value: value.const_value.nbytes + ENTRY_BYTES
            for value in self.readers
            if value.const_value is not None and self._dies(value)
        }

    def growth(self, group: Iterable[Expression]) -> float:
        """Return by how many bytes the weights grow if a group is folded."""
        gone = dict.fromkeys(group)
        stored = sum(map(self.bytes_of, self.stored(gone, gone.keys())))
        read = dict.fromkeys(value for one in gone for value in one.inputs if value)
        return stored - sum(
            self.weights[value]
            for value in read
            if value in self.weights and self.readers[value].keys() <= gone.keys()
        )

    def stored(
        self, group: Iterable[Expression], gone: Container[Expression]
    ) -> list[ir.Value]:
        """List the values of a group that something reads which is not gone."""
        return [
            value
            for one in group
            for value in one.nodes[0].outputs
            if value in self.outside
            or any(reader not in gone for reader in self.readers.get(value, ()))
        ]

    def bytes_of(self, value: ir.Value) -> float:
        """Return what a value takes in the file."""
        if isinstance(value.type, ir.SequenceType | ir.OptionalType):
            return math.inf
        array = self.known.arrays.get(value)
        if array is not None:
            return array.nbytes + ENTRY_BYTES
        known = value_bytes(value)
        return 0 if known is None else known + ENTRY_BYTES

    def without_largest(self, group: list[Expression]) -> list[Expression]:
        """Return a group without the makers of its largest stored values."""
        gone = set(group)
        stored = {
            one: max(map(self.bytes_of, self.stored([one], gone)), default=-1.0)
            for one in group
        }
        largest = max(stored.values())
        return [one for one in group if stored[one] < largest]

    def groups(self, expressions: Iterable[Expression]) -> list[list[Expression]]:
        """Group expressions that read each other, or a weight that only they read."""
        parent = {one: one for one in expressions}

        # Union-find over the expressions
        def root(one: Expression) -> Expression:
            while parent[one] is not one:
                parent[one] = parent[parent[one]]
                one = parent[one]
            return one

        # Join the readers of a value, and its maker
        for value in dict.fromkeys(v for one in parent for v in one.inputs):
            if value is None:
                continue
            linked = [one for one in self.readers[value] if one in parent]
            maker = self.known.maker.get(value)
            if maker in parent:
                linked.append(maker)
            elif value not in self.weights or len(linked) < len(self.readers[value]):
                continue
            for other in linked[1:]:
                parent[root(other)] = root(linked[0])
        found: dict[Expression, list[Expression]] = {}
        for one in parent:
            found.setdefault(root(one), []).append(one)
        return list(found.values())

    def _is_read_outside(self, one: Expression, place: int) -> bool:
        for node in one.nodes:
            equal = node.outputs[place]
            if equal.is_graph_output():
                return True
            if any(self._expression(use.node) is None for use in equal.uses()):
                return True
        return False

    def _expression(self, node: ir.Node) -> Expression | None:
        return self.known.maker.get(node.outputs[0]) if node.outputs else None

    def _dies(self, value: ir.Value) -> bool:
        return (
            value.is_initializer()
            and not value.is_graph_output()
            and value not in self.known.maker
            and all(self._expression(use.node) is not None for use in value.uses())
        )
