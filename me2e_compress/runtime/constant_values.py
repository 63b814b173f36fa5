"""Compute the values of a graph that no input can change."""

from collections.abc import Sequence

import onnx_ir as ir

from me2e_compress import rewrite
from me2e_compress.graph import is_standard
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.session import run_once

_UNSTEADY = frozenset(
    {
        "Bernoulli", "Multinomial", "RandomNormal", "RandomNormalLike",
        "RandomUniform", "RandomUniformLike",
    }
)  # fmt: skip


def constant_values(model: ir.Model) -> frozenset[ir.Value]:
    """Find the initializers and everything computed from them alone.

    Nodes with a body, calls of functions and operators of other domains count as
    computed. One look at each node: the graph must be in topological order.
    """
    found = {value for value in model.graph.initializers.values() if _is_fixed(value)}
    for node in model.graph:
        if (
            is_standard(node)
            and node.op_type not in _UNSTEADY
            and not any(_has_body(each) for each in node.attributes.values())
            and all(each is None or each in found for each in node.inputs)
        ):
            found.update(node.outputs)
    return frozenset(found)


def evaluate_constants(model: ir.Model, names: Sequence[str]) -> dict[str, Array]:
    """Compute constant values of a graph.

    Args:
        model: the graph; it stays as it is.
        names: values that :func:`constant_values` lists.

    Raises:
        GraphError: onnxruntime cannot compute them.
        FramesError: one of them depends on an input after all.
    """
    if not names:
        return {}
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


def _is_fixed(value: ir.Value) -> bool:
    return not value.is_graph_input()


def _has_body(attribute: ir.Attr) -> bool:
    return attribute.type in (ir.AttributeType.GRAPH, ir.AttributeType.GRAPHS)
