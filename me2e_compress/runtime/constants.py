"""Compute the constant values of a graph with onnxruntime."""

from collections.abc import Sequence

import onnx_ir as ir

from me2e_compress import rewrite
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.session import run_once


def evaluate_constants(model: ir.Model, names: Sequence[str]) -> dict[str, Array]:
    """Compute values that :func:`~me2e_compress.graph.nodes.constant_values` lists.

    Raises:
        GraphError: onnxruntime cannot compute them.
        FramesError: one of them depends on an input after all.
    """
    if not names:
        return {}
    # Cut a copy of the graph down to the wanted values and run it.
    part = model.clone()
    part.metadata_props.clear()  # it speaks of inputs and outputs that go
    made = {str(each.name): each for node in part.graph for each in node.outputs}
    part.graph.outputs.clear()
    part.graph.outputs.extend(made[name] for name in names)
    rewrite.sweep(part)
    used = [value for value in part.graph.inputs if value.uses()]
    part.graph.inputs.clear()
    part.graph.inputs.extend(used)
    return run_once(part, {})
