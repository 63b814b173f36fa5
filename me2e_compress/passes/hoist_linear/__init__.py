"""Multiply fewer rows: move products before nodes that repeat or add up rows."""

import dataclasses

import onnx_ir as ir

from me2e_compress.base.display import plural
from me2e_compress.graph import macs, nodes_of, opset_of
from me2e_compress.graph.nodes import graphs_of
from me2e_compress.graph.rewrite import remove_dead, value_names
from me2e_compress.graph.rewrite.raise_opset import OLDEST_OPSET
from me2e_compress.operators import FusedCall
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.hoist_linear.repeats import before_repeat
from me2e_compress.passes.hoist_linear.sums import layer_at, multiply_earlier

__all__ = ["HoistLinear"]

ROUNDS = 8
"""A round may move further what the last one moved: real graphs need two."""


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
    """

    name = "hoist-linear"
    exact = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Rewrite every node that has a cheaper form, until none has."""
        opset = opset_of(model)
        if opset < OLDEST_OPSET:
            return PassResult(model, 0)
        # Nodes that nothing reads would hold on to what they read
        unread = remove_dead(model.graph)
        names, macs_before = value_names(model.graph), _macs(model)
        bodies, products, others = list(graphs_of(model.graph)), 0, 0
        for _ in range(ROUNDS):
            moved = products + others
            for node in [node for body in bodies for node in body]:
                if node.graph is None:
                    continue
                # Before a repetition first, then by the algebra of layers and sums
                layer, by = layer_at(node), self.name
                if before_repeat(FusedCall(node, opset=opset, by=by, names=names)):
                    products += layer is not None
                    others += layer is None
                    continue
                if layer is not None:
                    last = layer.nodes[-1]
                    call = FusedCall(last, opset=opset, by=by, names=names)
                    products += multiply_earlier(layer, call)
            remove_dead(model.graph)
            if products + others == moved:
                break
        # Report products, other nodes and multiply-accumulates
        less = f"{(macs_before - _macs(model)) / 1e6:,.1f} MMACs fewer"
        notes = (
            (products, f"moved {plural(products, 'product')}: {less}"),
            (others, f"moved {plural(others, 'other node')} before repeated rows"),
            (unread, f"removed what nothing reads: {unread}"),
        )
        changes = products + others + unread
        return PassResult(model, changes, tuple(note for n, note in notes if n))


def _macs(model: ir.Model) -> int:
    return sum(macs(node) or 0 for node in nodes_of(model))
