"""The work that is saved when a value and the nodes only it needs are removed."""

import dataclasses
import math

import onnx_ir as ir

from me2e_compress.graph import static_shape
from me2e_compress.graph.activations import value_bytes
from me2e_compress.graph.rewrite import holds_numbers, sole_reader
from me2e_compress.passes.hoist_linear.linear_layers import LinearLayer, layer_behind
from me2e_compress.passes.hoist_linear.row_moves import moved_rows
from me2e_compress.passes.work import work


@dataclasses.dataclass(frozen=True)
class Amount:
    """Work in node starts (file bytes included), and multiply-accumulates."""

    work: float = 0.0
    macs: int = 0

    def plus(self, other: "Amount") -> "Amount":
        """Return the sum of both."""
        return Amount(self.work + other.work, self.macs + other.macs)


class OwnedWork:
    """Adds up and caches the work that goes with a value."""

    def __init__(self, rate: float) -> None:
        self.rate = rate
        self.known: dict[int, Amount] = {}

    def of(self, value: ir.Value) -> Amount:
        """Return the work that only this value needs, without recursion (long sums)."""
        waiting = [value]
        while waiting:
            last = waiting[-1]
            amount, sources = self._last_step(last)
            # Visit the sources first
            unknown = [each for each in sources if id(each) not in self.known]
            if unknown:
                waiting.extend(unknown)
                continue
            for source in sources:
                amount = amount.plus(self.known[id(source)])
            self.known[id(last)] = amount
            waiting.pop()
        return self.known[id(value)]

    def _last_step(self, value: ir.Value) -> tuple[Amount, list[ir.Value]]:
        node = value.producer()
        if id(value) in self.known:
            return self.known[id(value)], []
        if node is None or node.graph is not value.graph:
            return Amount(), []
        # A step is a layer, a move of rows, or a sum
        layer = layer_behind(value)
        if layer is not None:
            amount, sources = self._layer(layer), [layer.source]
        else:
            found = moved_rows(node)
            if found is None:
                if node.op_type not in ("Add", "Sub", "Concat"):
                    return Amount(), []
                found = tuple(each for each in node.inputs if each is not None)
            amount, sources = Amount(work(node)), list(found)
        if amount is None:
            return Amount(), []
        # Constants that only this step reads count by their size
        owned = [each for each in sources if sole_reader(each) is not None]
        stored = [each for each in owned if holds_numbers(each)]
        files = Amount(sum(map(self.file, stored)))
        return amount.plus(files), [each for each in owned if each not in stored]

    def _layer(self, layer: LinearLayer) -> Amount | None:
        if not all(sole_reader(each.outputs[0]) for each in layer.nodes):
            return None
        cost = sum(map(work, layer.nodes))
        if sole_reader(layer.weight) is not None:
            cost += self.file(layer.weight)
        columns = (static_shape(layer.result) or (0,))[-1]
        return Amount(cost, math.prod(static_shape(layer.source) or ()) * columns)

    def file(self, weight: ir.Value) -> float:
        """Return the price of a constant's bytes in the file."""
        return (value_bytes(weight) or 0) / self.rate
