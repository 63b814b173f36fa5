"""Choose which constant values become weights and which stay computed.

Folding removes nodes but may add bytes: a table repeated for every token is one node
and megabytes. The price of a node is in bytes and grows with its work per frame. The
cost of a choice is the price of the nodes that stay, plus the bytes of the stored
values and of the weights that are still read. The cheapest choice is a minimum cut
(Picard, "Maximal closure of a graph and applications to combinatorial problems",
1976).
"""

import dataclasses
import math
from collections.abc import Iterable

import onnx_ir as ir

from me2e_compress.graph.activations import value_bytes
from me2e_compress.passes.fold_constants.knowledge import Expression, Knowledge
from me2e_compress.passes.fold_constants.min_cut import FlowNetwork
from me2e_compress.passes.work import work

ENTRY_BYTES = 64
"""Bytes of an initializer in the file besides its data: name, shape, type."""

STEP_BYTES = 32
"""How finely a price is found that keeps to a budget."""


@dataclasses.dataclass
class FoldChoice:
    """Which values become initializers, and which expressions are no longer needed.

    ``kept`` counts the nodes that go on computing constants because that is cheaper.
    """

    values: list[ir.Value]
    gone: list[Expression]
    kept: int
    growth_bytes: int


def choose_within(known: Knowledge, bytes_per_node: int, most: float) -> FoldChoice:
    """Choose at the price given, or at the highest at which weights grow by ``most``.

    A lower price leaves those nodes computed whose removal costs the most bytes each.
    """
    choice = choose(known, bytes_per_node)
    low, high = 0, bytes_per_node
    if choice.growth_bytes <= most:
        return choice
    # bisect; at no price at all nothing grows the weights
    best = choose(known, low)
    while high - low > STEP_BYTES:
        middle = (low + high) // 2
        choice = choose(known, middle)
        if choice.growth_bytes <= most:
            low, best = middle, choice
        else:
            high = middle
    return best


def choose(known: Knowledge, bytes_per_node: int) -> FoldChoice:
    """Choose for every constant value whether it is stored or computed.

    A connected group that does not grow the weights is folded as a whole.
    """
    # Solve each group of connected expressions on its own
    prices = _Prices(known, bytes_per_node)
    gone: set[Expression] = set()
    for group in prices.groups():
        gone.update(group if prices.growth(group) <= 0 else prices.cheapest(group))
    # Store what remaining nodes still read
    values = [
        value
        for one in known.expressions
        if one in gone
        for value in one.nodes[0].outputs
        if prices.is_wanted(value, gone)
    ]
    kept = sum(len(one.nodes) for one in known.expressions if one not in gone)
    growth = sum(map(prices.value_bytes, values)) - prices.freed(gone)
    chosen = [one for one in known.expressions if one in gone]
    return FoldChoice(values, chosen, kept, int(growth))


class _Prices:
    """Prices of the values of one graph, and who reads them."""

    def __init__(self, known: Knowledge, bytes_per_node: int) -> None:
        self.known = known
        self.rate = bytes_per_node
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
        gone = set(group)
        made = (value for one in gone for value in one.nodes[0].outputs)
        stored = sum(self.value_bytes(value) for value in made if value in self.outside)
        return stored - self.freed(gone)

    def freed(self, gone: set[Expression]) -> float:
        read = {value for one in gone for value in one.inputs if value in self.weights}
        return sum(
            self.weights[value] for value in read if self.readers[value].keys() <= gone
        )

    def is_wanted(self, value: ir.Value, gone: set[Expression]) -> bool:
        return value in self.outside or not self.readers.get(value, {}).keys() <= gone

    def value_bytes(self, value: ir.Value) -> float:
        if isinstance(value.type, ir.SequenceType | ir.OptionalType):
            return math.inf
        array = self.known.arrays.get(value)
        if array is not None:
            return array.nbytes + ENTRY_BYTES
        known = value_bytes(value)
        return 0 if known is None else known + ENTRY_BYTES

    def cheapest(self, group: list[Expression]) -> list[Expression]:
        network = FlowNetwork()
        source, sink = network.vertex(), network.vertex()
        # Edges for nodes that stay and for values that are stored
        place = {one: network.vertex() for one in group}
        for one in group:  # one that stays is paid for in every frame
            price = self.rate * sum(map(work, one.nodes))
            network.edge(source, place[one], price)
            for value in one.nodes[0].outputs:  # one that goes: what it stores
                if value in self.outside:
                    network.edge(place[one], sink, self.value_bytes(value))
                elif value in self.readers:
                    stored = network.vertex()
                    network.edge(place[one], stored, self.value_bytes(value))
                    for reader in self.readers[value]:
                        network.edge(stored, place[reader])
        # A weight stays while any of its readers stays
        read = [value for one in group for value in one.inputs if value in self.weights]
        for value in dict.fromkeys(read):  # a weight that somebody reads stays
            weight = network.vertex()
            network.edge(source, weight, self.weights[value])
            for reader in self.readers[value]:
                network.edge(weight, place[reader])
        side = network.cut(source, sink)
        return [one for one in group if place[one] in side]

    def groups(self) -> list[list[Expression]]:
        parent = {one: one for one in self.known.expressions}

        # Union-find over the expressions
        def root(one: Expression) -> Expression:
            while parent[one] is not one:
                parent[one] = parent[parent[one]]
                one = parent[one]
            return one

        # Join the maker and readers of each value
        for value, readers in self.readers.items():
            maker = self.known.maker.get(value)
            linked = readers if maker is None else (maker, *readers)
            if maker is not None or value in self.weights:
                first, *others = linked
                for one in others:
                    parent[root(one)] = root(first)
        found: dict[Expression, list[Expression]] = {}
        for one in self.known.expressions:
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
