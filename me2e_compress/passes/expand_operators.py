"""Replace fused operators by standard ones."""

import dataclasses
from collections import Counter
from typing import ClassVar

import onnx_ir as ir

from me2e_compress import operators, rewrite
from me2e_compress.passes.base import Context, Pass, PassResult


@dataclasses.dataclass(frozen=True)
class ExpandOperators(Pass):
    """Write every fused operator, of any dialect, in standard operators.

    Given:   y = me2e.MultiScaleDeformableAttention(value, sizes, starts, at, weights)
    Result:  y = Transpose(... ReduceSum(Mul(GridSample(value, 2 * at - 1), weights)))

    The graph's opset decides which operators are used: GridSample from opset 16 on
    where the sizes of the maps are constants, else Gather. A plugin that no dialect
    names is left alone.
    """

    name: ClassVar[str] = "expand-operators"
    exact: ClassVar[bool] = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Expand the nodes of the graph, of its bodies and of its functions."""
        counts: Counter[str] = Counter()
        for fused in operators.fused_nodes(model):
            counts[fused.operator.name] += 1
            operators.expand(
                fused.node, opset=fused.opset, by=self.name, names=fused.names
            )
        if counts:
            operators.import_domains(model)
            rewrite.sweep(model)
        done = ", ".join(f"{count} {name}" for name, count in counts.items())
        notes = (f"expanded: {done}",) if done else ()
        return PassResult(model, counts.total(), notes)
