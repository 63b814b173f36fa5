"""Multiply fewer rows: move products before nodes that repeat or add up rows."""

import dataclasses
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.display import counted
from me2e_compress.graph import macs, nodes_of, opset_of
from me2e_compress.graph.rewrite import graphs_of, remove_dead, value_names
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.hoist_linear.layers import layer_at
from me2e_compress.passes.hoist_linear.rebuilding import Rewriter
from me2e_compress.passes.hoist_linear.repeats import before_repeat
from me2e_compress.passes.hoist_linear.sums import multiply_earlier
from me2e_compress.passes.work import BYTES_PER_NODE

__all__ = ["HoistLinear"]

OLDEST_OPSET = 8
"""The first opset that has Expand and broadcasts as numpy does."""

ROUNDS = 8
"""A round may move further what the last one moved: real graphs need two."""


@dataclasses.dataclass
class _Tally:
    products: int = 0
    others: int = 0
    unread: int = 0
    left: int = 0

    @property
    def changes(self) -> int:
        return self.products + self.others + self.unread

    def notes(self, macs: int) -> tuple[str, ...]:
        found = []
        if self.products:
            less = f"{macs / 1e6:,.1f} MMACs fewer"
            found.append(f"moved {counted(self.products, 'product')}: {less}")
        if self.others:
            found.append(
                f"moved {counted(self.others, 'other node')} before repeated rows"
            )
        if self.left:
            what = counted(self.left, "node")
            found.append(
                f"left {what} behind what repeats: others read it too, or it is small"
            )
        if self.unread:
            found.append(f"removed what nothing reads: {self.unread}")
        return tuple(found)


@dataclasses.dataclass(frozen=True)
class HoistLinear(Pass):
    """Multiply before rows are repeated, not after: the same products, but fewer.

    Given:   Tile(x) -> MatMul;  x + (p P + c) -> MatMul;  Expand(x) -> Relu -> MatMul

    Result:  MatMul(x) -> Tile;  x W + p (P W) + c W;  x -> Relu -> MatMul -> Expand

    Three fusions (:mod:`me2e_compress.passes.hoist_linear.sums` writes the algebra
    out). A layer, a row-wise operator (LayerNorm, Relu), a Transpose or a Concat is
    computed before the rows that it reads are repeated (Tile, Expand, a Concat of one
    value), also where views have split or merged their axes. Two consecutive layers
    become one. A layer is distributed over a sum of which a term is constant, or has
    fewer rows, or is a layer of few columns. Each is done where it needs fewer
    multiply-accumulates and is less work in total (:mod:`me2e_compress.passes.work`).
    Sizes must be known. Outputs are equal up to rounding.

    Attributes:
        bytes_per_node: how many bytes of new weights the work of one node may cost.
    """

    name: ClassVar[str] = "hoist-linear"
    exact: ClassVar[bool] = True
    bytes_per_node: int = BYTES_PER_NODE

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Rewrite every node that has a cheaper form, until none has."""
        tally, opset = _Tally(), opset_of(model)
        if opset < OLDEST_OPSET:
            return PassResult(model, 0)
        tally.unread = remove_dead(model.graph)  # it would hold on to what it reads
        names, before = value_names(model.graph), _macs(model)
        rewriters = [
            Rewriter(each, names, self.name) for each in graphs_of(model.graph)
        ]
        for _ in range(ROUNDS):
            changes, tally.left = tally.changes, 0  # those of the last round are left
            for rewriter in rewriters:
                self._round(rewriter, opset, tally)
            if tally.changes == changes:
                break
            remove_dead(model.graph)
        return PassResult(model, tally.changes, tally.notes(before - _macs(model)))

    def _round(self, rewriter: Rewriter, opset: int, tally: _Tally) -> None:
        for node in list(rewriter.graph):
            if node.graph is not rewriter.graph:
                continue
            layer = layer_at(node)
            moved = before_repeat(node, rewriter, opset)
            if moved:
                tally.products += layer is not None
                tally.others += layer is None
                continue
            tally.left += moved is False
            if layer is not None:
                tally.products += multiply_earlier(layer, rewriter, self.bytes_per_node)


def _macs(model: ir.Model) -> int:
    return sum(macs(node) or 0 for node in nodes_of(model))
