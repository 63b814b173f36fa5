"""Multiply fewer rows: move products in front of what repeats or adds up their rows."""

import dataclasses
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.display import counted
from me2e_compress.graph import opset_of
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.hoist_linear.batch_operands import split_operand
from me2e_compress.passes.hoist_linear.least_work import Prices
from me2e_compress.passes.hoist_linear.linear_layers import layer_at
from me2e_compress.passes.hoist_linear.rebuilding import Rewriter
from me2e_compress.passes.hoist_linear.repeated_rows import do_before_repeats
from me2e_compress.passes.hoist_linear.shared_sources import merge_layers
from me2e_compress.passes.work import BYTES_PER_NODE
from me2e_compress.rewrite import graphs_of, remove_dead, value_names

__all__ = ["HoistLinear"]

OLDEST_OPSET = 8
"""Broadcasting and Expand are what they are since."""

ROUNDS = 8
"""What one round moves, the next may move further: real graphs need two."""


@dataclasses.dataclass
class _Tally:
    products: int = 0
    others: int = 0
    operands: int = 0
    merged: int = 0
    unread: int = 0
    macs: int = 0

    @property
    def changes(self) -> int:
        moved = self.products + self.others + self.operands
        return moved + self.merged + self.unread

    def notes(self) -> tuple[str, ...]:
        found = []
        if products := self.products + self.operands:
            less = f"{self.macs / 1e6:,.1f} MMACs fewer"
            found.append(f"moved {counted(products, 'product')}: {less}")
        if self.others:
            found.append(
                f"moved {counted(self.others, 'other node')} before repeated rows"
            )
        if self.merged:
            found.append(f"merged {counted(self.merged, 'layer')} by a shared input")
        if self.unread:
            found.append(f"removed what nothing reads: {self.unread}")
        return tuple(found)


@dataclasses.dataclass(frozen=True)
class HoistLinear(Pass):
    """Multiply before rows are repeated, not after: the same products, fewer of them.

    Given:   Tile(x) -> MatMul;  x + (p P + c) -> MatMul;  Expand(x) -> Relu -> MatMul
    Result:  MatMul(x) -> Tile;  x W + p (P W) + c W;  x -> Relu -> MatMul -> Expand

    A product moves in front of what only rearranges or repeats rows (Tile, Expand,
    Gather, Concat, Slice, Reshape and Transpose that leave the last axis); it is
    distributed over a sum, or over columns side by side, of which a part is small or
    repeated; and two linear layers in a row become one. Each is done only where the
    multiply-accumulates become fewer and the whole cheaper: nodes, what they move, and
    new weights (:mod:`me2e_compress.passes.work`). Whatever else is done to every row
    alike (a bias, LayerNorm, Relu) moves in front of their repetition too. Sizes must
    be known.

    Equal up to rounding.

    Attributes:
        bytes_per_node: how many bytes of new weights the work of one node may cost.
        merge_shared: merge the layers of a module that read the same value (queries,
            keys and values) into one and split what it gives; off, since onnxruntime
            is slower so from 300 rows on, and int8 would have one range for all.
    """

    name: ClassVar[str] = "hoist-linear"
    exact: ClassVar[bool] = True
    bytes_per_node: int = BYTES_PER_NODE
    merge_shared: bool = False

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Ask for every node whether there is a cheaper way, until there is none."""
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
            for rewriter in rewriters:
                self._round(rewriter, opset, tally)
            if self.merge_shared and tally.changes == before:
                tally.merged += sum(merge_layers(each, opset) for each in rewriters)
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
            layer = layer_at(node)
            found = None if layer is None else prices.saving(layer)
            if layer is not None and found is not None:
                if rewriter.replace(layer, found.way):
                    tally.products += 1
                    tally.macs += found.macs
            elif do_before_repeats(node, rewriter, opset):
                tally.others += 1
            elif (fewer := split_operand(node, rewriter)) is not None:
                tally.operands += 1
                tally.macs += fewer
            if tally.changes > before:
                prices.forget()
