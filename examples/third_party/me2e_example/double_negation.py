"""Two negations in a row are none."""

import dataclasses
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.graph.nodes import maker
from me2e_compress.graph.rewrite import bypass, remove_dead
from me2e_compress.passes import Context, Pass, PassResult


@dataclasses.dataclass(frozen=True)
class DropDoubleNegation(Pass):
    """Read a value instead of the negation of its negation.

    Given:   y = Neg(Neg(x));  z = Relu(y)
    Result:  z = Relu(x)
    """

    name: ClassVar[str] = "drop-double-negation"
    exact: ClassVar[bool] = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Look at every negation."""
        changes = 0
        for node in model.graph:
            inner = maker(node.inputs[0], "Neg") if node.op_type == "Neg" else None
            if inner is not None and inner.inputs[0] is not None:
                changes += bypass(node.outputs[0], inner.inputs[0])
        if changes:
            remove_dead(model.graph)
        return PassResult(model, changes)
