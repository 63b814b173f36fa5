"""Where to cut: which constant values become weights, and which stay computed.

Folding removes nodes and may add bytes: a table repeated for every token is one node
and megabytes. A node is worth so many bytes; each value is then either stored or
computed, whichever is cheaper, the price of what it is computed from being shared
among all who read it (the *area flow* of technology mapping: Manohararajah, Brown,
Vranesic, "Heuristics for area minimization in LUT-based FPGA technology mapping",
2006). What the heuristic gets wrong is found by exact accounts and taken back.
"""

import dataclasses
import math

import onnx_ir as ir

from me2e_compress.graph import static_shape
from me2e_compress.passes.fold_constants.knowledge import Expression, Knowledge

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
    """Decide for every constant value whether it is stored or computed."""
    market = _Market(known, bytes_per_node)
    choice, losing = market.clear(strict=set(), frozen=set())
    if losing:
        strict = losing
        choice, losing = market.clear(strict=strict, frozen=set())
        if losing:
            choice, _ = market.clear(strict=strict, frozen=losing)
    return choice


class _Market:
    """Prices of the values of one graph."""

    def __init__(self, known: Knowledge, bytes_per_node: int) -> None:
        self.known = known
        self.rate = bytes_per_node
        self.weights = self._weights()
        self.readers = self._readers()
        self.lot = self._lots()

    def clear(self, strict: set[int], frozen: set[int]) -> tuple[FoldChoice, set[int]]:
        """Choose; name the lots that grow the file beyond what their nodes are worth.

        Args:
            strict: lots whose weights are taken to stay in any case.
            frozen: lots in which nothing is folded.
        """
        keep_price = self._keep_prices(strict)
        wanted: set[ir.Value] = set()
        values: list[ir.Value] = []
        gone: list[Expression] = []
        for one in reversed(self.known.expressions):
            outputs = [
                value
                for value in one.nodes[0].outputs
                if value in wanted or self._is_read_outside(one, value)
            ]
            stored = sum(self._bytes(value) for value in outputs)
            if self.lot[one] in frozen or keep_price[one] < stored:
                wanted.update(value for value in one.inputs if value is not None)
            else:
                gone.append(one)
                values.extend(reversed(outputs))
        values.reverse()
        gone.reverse()
        accounts = self._accounts(values, gone)
        losing = {lot for lot, (grown, worth) in accounts.items() if grown > worth}
        count = sum(len(one.nodes) for one in self.known.expressions)
        removed = sum(len(one.nodes) for one in gone)
        growth = sum(grown for grown, _ in accounts.values())
        return FoldChoice(values, gone, count - removed, int(growth)), losing - frozen

    def _bytes(self, value: ir.Value) -> float:
        if isinstance(value.type, ir.SequenceType | ir.OptionalType):
            return math.inf
        array = self.known.arrays.get(value)
        if array is not None:
            return array.nbytes + ENTRY_BYTES
        shape = static_shape(value)
        if shape is None or value.dtype is None:
            return 0
        return math.prod(shape) * value.dtype.itemsize + ENTRY_BYTES

    def _is_read_outside(self, one: Expression, value: ir.Value) -> bool:
        place = one.nodes[0].outputs.index(value)
        for node in one.nodes:
            equal = node.outputs[place]
            if equal.is_graph_output():
                return True
            if any(self._expression(use.node) is None for use in equal.uses()):
                return True
        return False

    def _expression(self, node: ir.Node) -> Expression | None:
        return self.known.maker.get(node.outputs[0]) if node.outputs else None

    def _weights(self) -> dict[ir.Value, list[Expression]]:
        """List the initializers that only constant nodes read, and by whom."""
        found: dict[ir.Value, list[Expression]] = {}
        refused: set[ir.Value] = set()
        for one in self.known.expressions:
            for value in one.inputs:
                if value is None or value in self.known.maker or value in refused:
                    continue
                readers = [self._expression(use.node) for use in value.uses()]
                inside = [reader for reader in readers if reader is not None]
                if (
                    len(inside) < len(readers)
                    or value.is_graph_output()
                    or not value.is_initializer()
                ):
                    refused.add(value)
                else:
                    found[value] = list(dict.fromkeys(inside))
        return found

    def _readers(self) -> dict[ir.Value, int]:
        count: dict[ir.Value, int] = {}
        for one in self.known.expressions:
            for value in dict.fromkeys(one.inputs):
                if value is not None:
                    count[value] = count.get(value, 0) + 1
        for one in self.known.expressions:
            for value in one.nodes[0].outputs:
                if self._is_read_outside(one, value):
                    count[value] = count.get(value, 0) + 1
        return count

    def _keep_prices(self, strict: set[int]) -> dict[Expression, float]:
        price: dict[Expression, float] = {}
        for one in self.known.expressions:
            total = float(self.rate * len(one.nodes))
            for value in dict.fromkeys(one.inputs):
                if value is None:
                    continue
                maker = self.known.maker.get(value)
                if maker is not None:
                    whole = min(self._bytes(value), price[maker])
                    total += whole / self.readers[value]
                elif value in self.weights and self.lot[one] not in strict:
                    total += self._weight_bytes(value) / self.readers[value]
            price[one] = total
        return price

    def _weight_bytes(self, value: ir.Value) -> int:
        tensor = value.const_value
        return 0 if tensor is None else tensor.nbytes + ENTRY_BYTES

    def _lots(self) -> dict[Expression, int]:
        """Number the groups of expressions that share values or weights."""
        parent = {one: one for one in self.known.expressions}

        def root(one: Expression) -> Expression:
            while parent[one] is not one:
                parent[one] = parent[parent[one]]
                one = parent[one]
            return one

        for one in self.known.expressions:
            for value in one.inputs:
                if value is not None and value in self.known.maker:
                    parent[root(self.known.maker[value])] = root(one)
        for readers in self.weights.values():
            for one in readers[1:]:
                parent[root(readers[0])] = root(one)
        numbers: dict[Expression, int] = {}
        return {
            one: numbers.setdefault(root(one), len(numbers))
            for one in self.known.expressions
        }

    def _accounts(
        self, values: list[ir.Value], gone: list[Expression]
    ) -> dict[int, tuple[float, float]]:
        """Add up, for every lot, growth in bytes and the worth of the nodes removed."""
        grown: dict[int, float] = {}
        worth: dict[int, float] = {}
        for value in values:
            lot = self.lot[self.known.maker[value]]
            grown[lot] = grown.get(lot, 0) + self._bytes(value)
        for one in gone:
            lot = self.lot[one]
            worth[lot] = worth.get(lot, 0) + self.rate * len(one.nodes)
        away = set(gone)
        for value, readers in self.weights.items():
            if all(one in away for one in readers):
                lot = self.lot[readers[0]]
                grown[lot] = grown.get(lot, 0) - self._weight_bytes(value)
        return {lot: (grown.get(lot, 0), worth[lot]) for lot in worth}
