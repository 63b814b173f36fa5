"""The cheapest way to multiply a value by a matrix.

The product of rearranged or repeated rows is the rearranged or repeated product; the
product of a sum (or of concatenated columns) is a sum of products; two linear layers
are one with the product of their matrices; a product of constants is a constant. Each
way is priced as in :mod:`me2e_compress.passes.work`: work per frame, memory traffic,
and new weights in the file.
"""

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import static_shape
from me2e_compress.graph.nodes import VIEWS
from me2e_compress.graph.rewrite import holds_numbers, is_standard, sole_reader
from me2e_compress.passes.hoist_linear.linear_layers import LinearLayer, layer_behind
from me2e_compress.passes.hoist_linear.owned_work import Amount, OwnedWork
from me2e_compress.passes.hoist_linear.row_moves import moved_rows, without_repeats
from me2e_compress.passes.hoist_linear.ways import (
    Composed,
    Direct,
    Distributed,
    Moved,
    Precomputed,
    Term,
    Way,
    uses_weight,
)
from me2e_compress.passes.work import MACS_PER_NODE, MOVED_BYTES_PER_NODE, item_bytes

DEEPEST = 32
"""Largest number of consecutive nodes examined before a product."""


@dataclasses.dataclass(frozen=True)
class Price:
    """The cost of a way: work per frame in node starts, with file bytes, and MACs."""

    way: Way
    work: float
    macs: int


@dataclasses.dataclass(frozen=True)
class Question:
    """A product of a value [..., K] with N ``columns`` whose price is wanted.

    ``owned``: only this product reads the value. ``fresh``: the matrix is new and takes
    bytes in the file. ``depth``: how many earlier nodes may still be examined.
    """

    value: ir.Value
    columns: int
    owned: bool
    fresh: bool
    depth: int = DEEPEST

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the value."""
        return static_shape(self.value) or ()

    @property
    def product_bytes(self) -> float:
        """The size of the product in memory."""
        return math.prod(self.shape[:-1]) * self.columns * item_bytes(self.value)

    def of(
        self, value: ir.Value, *, owned: bool | None = None, fresh: bool = False
    ) -> "Question":
        """Ask for an earlier value."""
        mine = self.owned and sole_reader(value) is not None
        return Question(
            value, self.columns, mine if owned is None else owned,
            self.fresh or fresh, self.depth - 1,
        )  # fmt: skip


class Prices:
    """Finds the cheapest ways, and caches prices until the graph changes."""

    def __init__(self, bytes_per_node: int) -> None:
        self.rate = max(bytes_per_node, 1e-9)
        self.known: dict[tuple[int, int, bool, bool], Price] = {}
        self.owned = OwnedWork(self.rate)

    def forget(self) -> None:
        """Clear the cache after a change of the graph."""
        self.known.clear()
        self.owned.known.clear()

    def saving(self, layer: LinearLayer) -> Price | None:
        """Return a cheaper way of fewer MACs and its savings; None if there is none."""
        # Compare the direct product with the best other way
        columns = (static_shape(layer.product.outputs[0]) or (0,))[-1]
        source = layer.source
        asked = Question(source, columns, sole_reader(source) is not None, fresh=False)
        now, best = self.direct(asked), self.indirect(asked)
        if best is None:
            return None
        # The weight may become unused
        saved = now.work - best.work
        if not uses_weight(best.way) and sole_reader(layer.weight) is not None:
            saved += self.owned.file(layer.weight)
        if saved < 1.0 or best.macs >= now.macs:
            return None
        return Price(best.way, saved, now.macs - best.macs)

    def cheapest(self, asked: Question) -> Price:
        """Return the cheapest way."""
        key = (id(asked.value), asked.columns, asked.owned, asked.fresh)
        found = self.known.get(key)
        if found is None:
            now = self.direct(asked)
            other = self.indirect(asked) if asked.depth else None
            found = now if other is None or other.work >= now.work else other
            self.known[key] = found
        return found

    def direct(self, asked: Question) -> Price:
        """Price the product of the value as it is; the nodes of an owned value stay."""
        if holds_numbers(asked.value):
            return Price(Precomputed(asked.value), asked.product_bytes / self.rate, 0)
        macs = math.prod(asked.shape) * asked.columns
        moved = asked.product_bytes + math.prod(asked.shape) * item_bytes(asked.value)
        cost = 1.0 + macs / MACS_PER_NODE + moved / MOVED_BYTES_PER_NODE
        if asked.fresh:
            matrix = asked.shape[-1] * asked.columns * item_bytes(asked.value)
            cost += matrix / self.rate
        held = self.owned.of(asked.value) if asked.owned else Amount()
        return Price(Direct(asked.value), cost + held.work, macs + held.macs)

    def indirect(self, asked: Question) -> Price | None:
        """Price the ways through the node that computes the value, if there are any."""
        node = asked.value.producer()
        if node is None or node.graph is not asked.value.graph or not is_standard(node):
            return None
        sources = moved_rows(node)
        if sources is not None:
            return self._moved(asked, node, sources)
        layer = layer_behind(asked.value)
        if layer is not None:
            return self._composed(asked, layer)
        if node.op_type in ("Add", "Sub") or node.op_type == "Concat":
            return self._distributed(asked, node)
        return None

    def _moved(
        self, asked: Question, node: ir.Node, sources: tuple[ir.Value, ...]
    ) -> Price:
        prices = {id(value): self.cheapest(asked.of(value)) for value in sources}
        # Views move no data
        cost = 1.0 + sum(part.work for part in prices.values())  # each is made once
        if node.op_type not in VIEWS:
            read = sum(asked.of(value).product_bytes for value in sources)
            cost += (read + asked.product_bytes) / MOVED_BYTES_PER_NODE
        way = Moved(node, tuple(prices[id(value)].way for value in sources))
        return Price(way, cost, sum(part.macs for part in prices.values()))

    def _composed(self, asked: Question, layer: LinearLayer) -> Price:
        owned = asked.owned and all(
            sole_reader(node.outputs[0]) is not None for node in layer.nodes
        )
        source = layer.source
        mine = owned and sole_reader(source) is not None
        inner = self.cheapest(asked.of(source, owned=mine, fresh=True))
        return Price(Composed(layer, inner.way), inner.work, inner.macs)

    def _distributed(self, asked: Question, node: ir.Node) -> Price | None:
        found = list(terms_of(node, asked.shape))
        if not found:
            return None
        terms, cost, macs = [], 0.0, 0
        # The product of each term
        for value, owned, rows in found:
            mine = asked.owned and owned
            one = self.cheapest(asked.of(value, owned=mine, fresh=rows is not None))
            shape = static_shape(value) or ()
            terms.append(Term(one.way, shape, rows))
            cost, macs = cost + one.work, macs + one.macs
            made = math.prod(shape[:-1]) * asked.columns * item_bytes(asked.value)
            cost += made / MOVED_BYTES_PER_NODE
        # Adding the products up
        sums = len(terms) - 1
        cost += sums + sums * asked.product_bytes / MOVED_BYTES_PER_NODE
        return Price(Distributed(node, tuple(terms)), cost, macs)


def terms_of(
    node: ir.Node, shape: tuple[int, ...]
) -> Iterator[tuple[ir.Value, bool, tuple[int, int] | None]]:
    """Yield the terms of a sum: value, whether only the sum reads it, its matrix rows.

    Repetitions are skipped where adding repeats the term anyway.
    """
    values = [value for value in node.inputs if value is not None]
    shapes = [static_shape(value) for value in values]
    if len(values) < 2 or any(not each for each in shapes) or 0 in shape:
        return
    # Only sums of equal width, or a Concat of columns
    axis = node.attributes.get_int("axis", 0) if node.op_type == "Concat" else -1
    if axis not in (-1, len(shape) - 1):
        return
    widths = [each[-1] for each in shapes if each]
    if node.op_type != "Concat" and any(
        width != shape[-1] and not holds_numbers(value)
        for value, width in zip(values, widths, strict=True)
    ):
        return
    leads = [each[:-1] for each in shapes if each]
    start = 0
    # Skip repetitions that broadcasting makes unnecessary
    for at, value in enumerate(values):
        owned = sole_reader(value) is not None
        source = without_repeats(value)
        inner = static_shape(source)
        if source is not None and inner and inner[-1] == widths[at]:
            others = [*leads[:at], inner[:-1], *leads[at + 1 :]]
            if np.broadcast_shapes(*others) == shape[:-1]:
                leads = others
                owned = owned and sole_reader(source) is not None
                value = source
        rows = (start, start + widths[at]) if node.op_type == "Concat" else None
        start += widths[at]
        yield value, owned, rows
