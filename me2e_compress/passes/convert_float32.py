"""Convert a float16 graph to float32."""

import dataclasses

import onnx_ir as ir

from me2e_compress.base.display import plural
from me2e_compress.graph import rewrite
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.convert_float16.element_types import (
    FLOAT,
    HALF,
    ElementTypes,
    Retyping,
)


@dataclasses.dataclass(frozen=True)
class ConvertFloat32(Pass):
    """Compute in float32 what a graph computes in float16.

    Given:   y = Conv(x, w_half, b_half)                       x, y float16

    Result:  y = Cast<float16>(Conv(Cast<float>(x), w, b))

    A CPU has almost no float16 kernels: onnxruntime casts every operand back and forth.
    Inputs and outputs keep their types. Nodes that round to float16 on purpose, plugins
    and bodies of If, Loop and Scan are left alone.
    """

    name = "convert-float32"
    exact = False

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Retype every node that can be retyped and drop the Casts that become idle."""
        types = ElementTypes(model, HALF, FLOAT)
        nodes = [n for n in model.graph if types.inputs(n) or types.outputs(n)]
        retyping = Retyping(model, types, self.name)
        retyping.run(nodes)
        # Casts that cast to what they read have become idle
        changes = retyping.changed + sum(
            rewrite.bypass(node.outputs[0], source)
            for node in list(model.graph)
            if node.op_type == "Cast"
            and (source := node.inputs[0]) is not None
            and source.dtype == node.outputs[0].dtype == FLOAT
        )
        if changes:
            rewrite.sweep(model)
        computing = sum(node.op_type != "Cast" for node in nodes)
        return PassResult(model, changes, (f"{plural(computing, 'node')} in float32",))
