"""Multiply fewer rows: move products before nodes that repeat or add up rows."""

import dataclasses
from collections import Counter
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.display import counted
from me2e_compress.graph import opset_of
from me2e_compress.graph.rewrite import graphs_of, remove_dead, value_names
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.hoist_linear.batch_operands import split_operand
from me2e_compress.passes.hoist_linear.least_work import Prices
from me2e_compress.passes.hoist_linear.linear_layers import layer_at
from me2e_compress.passes.hoist_linear.rebuilding import Rewriter
from me2e_compress.passes.hoist_linear.repeated_rows import do_before_repeats
from me2e_compress.passes.hoist_linear.sunk_repeats import sink_repeats
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
    operands: int = 0
    unread: int = 0
    left: int = 0
    macs: int = 0
    refused: Counter[str] = dataclasses.field(default_factory=Counter)

    @property
    def changes(self) -> int:
        return self.products + self.others + self.operands + self.unread

    def notes(self) -> tuple[str, ...]:
        found = []
        if products := self.products + self.operands:
            less = f"{self.macs / 1e6:,.1f} MMACs fewer"
            found.append(f"moved {counted(products, 'product')}: {less}")
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
        for reason, count in sorted(self.refused.items()):
            whole = counted(count, "product")
            found.append(f"left {whole} with keys or values as they are: {reason}")
        return tuple(found)


@dataclasses.dataclass(frozen=True)
class HoistLinear(Pass):
    """Multiply before rows are repeated, not after: the same products, but fewer.

    Given:   Tile(x) -> MatMul;  x + (p P + c) -> MatMul;  Expand(x) -> Relu -> MatMul

    Result:  MatMul(x) -> Tile;  x W + p (P W) + c W;  x -> Relu -> MatMul -> Expand

    A product moves in front of nodes that only rearrange or repeat rows and keep the
    last axis (Tile, Expand, Gather, Concat, Slice, Reshape and Transpose). It is
    distributed over a sum, or over concatenated columns, of which a part is small or
    repeated. Two consecutive linear layers become one. Each rewrite is done only where
    it needs fewer multiply-accumulates and is cheaper in total: nodes, memory traffic
    and new weights (:mod:`me2e_compress.passes.work`). Other row-wise operators (a
    bias, LayerNorm, Relu) also move in front of repetitions, as do Transpose and Concat
    (of constants that repeat, too), also where views have split or merged the axes
    behind those that repeat. Keys and values that the batch shares but for their
    positions are multiplied term by term. Sizes must be known. Outputs are equal up to
    rounding.

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
        names = value_names(model.graph)
        rewriters = [
            Rewriter(each, names, self.name) for each in graphs_of(model.graph)
        ]
        for _ in range(ROUNDS):
            before = tally.changes
            tally.left = 0  # those of the last round are left
            tally.refused.clear()
            for rewriter in rewriters:
                self._round(rewriter, opset, tally)
            if tally.changes == before:
                break
            remove_dead(model.graph)
        return PassResult(model, tally.changes, tally.notes())

    def _round(self, rewriter: Rewriter, opset: int, tally: _Tally) -> None:
        body = rewriter.graph
        prices = Prices(self.bytes_per_node)
        for node in list(body):
            if node.graph is not body:
                continue
            before = tally.changes
            # Try products first, then row-wise nodes, then attention operands
            layer = layer_at(node)
            found = None if layer is None else prices.saving(layer)
            if layer is not None and found is not None:
                if rewriter.replace(layer, found.way):
                    tally.products += 1
                    tally.macs += found.macs
            elif do_before_repeats(node, rewriter, opset):
                tally.others += 1
            elif (sunk := sink_repeats(node, rewriter, opset)) is not None:
                tally.others += sunk
                tally.left += not sunk
            elif isinstance(fewer := split_operand(node, rewriter), int):
                tally.operands += 1
                tally.macs += fewer
            elif fewer is not None:
                tally.refused[fewer] += 1
            if tally.changes > before:
                prices.forget()
