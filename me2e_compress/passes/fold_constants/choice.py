"""Where to cut: which constant values become weights, and which stay computed.

Folding removes nodes and may add bytes: a table repeated for every token is one node
and megabytes. A node is worth so many bytes, and more where it works long in every
frame: an attention between constants may take more time than its result takes bytes.
What a choice costs is the worth of the nodes that stay, the bytes of the values that
are stored, and those of the weights that are still read. The cheapest choice is a
minimum cut (Picard, "Maximal closure of a graph and applications to combinatorial
problems", 1976): each node is on the side of what goes or of what stays.
"""

import dataclasses
import math
from collections.abc import Iterable

import onnx_ir as ir

from me2e_compress.graph import static_shape
from me2e_compress.passes.fold_constants.knowledge import Expression, Knowledge
from me2e_compress.passes.fold_constants.min_cut import FlowNetwork
from me2e_compress.passes.work import work

ENTRY_BYTES = 64
"""What an initializer takes in the file beside its data: name, shape, type."""


@dataclasses.dataclass
class FoldChoice:
    """What to fold.

    Attributes:
        values: the values that become initializers, in graph order.
        gone: the expressions whose nodes are no longer needed.
        kept: how many nodes go on computing constants because they are cheaper.
        growth_bytes: by how much the weights grow; negative if they shrink.
    """

    values: list[ir.Value]
    gone: list[Expression]
    kept: int
    growth_bytes: int


def choose(known: Knowledge, bytes_per_node: int) -> FoldChoice:
    """Decide for every constant value whether it is stored or computed.

    A lot that shrinks the weights, or leaves them as they are, goes as a whole.
    """
    market = _Market(known, bytes_per_node)
    gone: set[Expression] = set()
    for lot in market.lots():
        gone.update(lot if market.growth(lot) <= 0 else market.cheapest(lot))
    values = [
        value
        for one in known.expressions
        if one in gone
        for value in one.nodes[0].outputs
        if market.is_wanted(value, gone)
    ]
    kept = sum(len(one.nodes) for one in known.expressions if one not in gone)
    growth = sum(map(market.value_bytes, values)) - market.freed(gone)
    chosen = [one for one in known.expressions if one in gone]
    return FoldChoice(values, chosen, kept, int(growth))


class _Market:
    """Prices of the values of one graph, and who reads them."""

    def __init__(self, known: Knowledge, bytes_per_node: int) -> None:
        self.known = known
        self.rate = bytes_per_node
        self.readers: dict[ir.Value, dict[Expression, None]] = {}
        for one in known.expressions:
            for value in one.inputs:
                if value is not None:
                    self.readers.setdefault(value, {})[one] = None
        self.outside = {
            value
            for one in known.expressions
            for place, value in enumerate(one.nodes[0].outputs)
            if self._is_read_outside(one, place)
        }
        self.weights = {
            value: value.const_value.nbytes + ENTRY_BYTES
            for value in self.readers
            if value.const_value is not None and self._dies(value)
        }

    def growth(self, lot: Iterable[Expression]) -> float:
        """Return by how much the weights grow if a whole lot goes."""
        gone = set(lot)
        made = (value for one in gone for value in one.nodes[0].outputs)
        stored = sum(self.value_bytes(value) for value in made if value in self.outside)
        return stored - self.freed(gone)

    def freed(self, gone: set[Expression]) -> float:
        """Return the bytes of the weights that nobody reads any more."""
        read = {value for one in gone for value in one.inputs if value in self.weights}
        return sum(
            self.weights[value] for value in read if self.readers[value].keys() <= gone
        )

    def is_wanted(self, value: ir.Value, gone: set[Expression]) -> bool:
        """Return whether what stays reads a value."""
        return value in self.outside or not self.readers.get(value, {}).keys() <= gone

    def value_bytes(self, value: ir.Value) -> float:
        """Return what a value takes as an initializer."""
        if isinstance(value.type, ir.SequenceType | ir.OptionalType):
            return math.inf
        array = self.known.arrays.get(value)
        if array is not None:
            return array.nbytes + ENTRY_BYTES
        shape = static_shape(value)
        if shape is None or value.dtype is None:
            return 0
        return math.prod(shape) * value.dtype.itemsize + ENTRY_BYTES

    def cheapest(self, lot: list[Expression]) -> list[Expression]:
        """Return what goes of a lot where that costs least: the source's side."""
        network = FlowNetwork()
        source, sink = network.vertex(), network.vertex()
        place = {one: network.vertex() for one in lot}
        for one in lot:  # one that stays is paid for in every frame
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
        read = [value for one in lot for value in one.inputs if value in self.weights]
        for value in dict.fromkeys(read):  # a weight that somebody reads stays
            weight = network.vertex()
            network.edge(source, weight, self.weights[value])
            for reader in self.readers[value]:
                network.edge(weight, place[reader])
        side = network.cut(source, sink)
        return [one for one in lot if place[one] in side]

    def lots(self) -> list[list[Expression]]:
        """Group the expressions that share values or weights."""
        parent = {one: one for one in self.known.expressions}

        def root(one: Expression) -> Expression:
            while parent[one] is not one:
                parent[one] = parent[parent[one]]
                one = parent[one]
            return one

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
        """Return whether a weight is read by constant nodes alone."""
        return (
            value.is_initializer()
            and not value.is_graph_output()
            and value not in self.known.maker
            and all(self._expression(use.node) is not None for use in value.uses())
        )
