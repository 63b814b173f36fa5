"""Ranges that run only as long as nobody knows the shape of their bounds.

ONNX's own function bodies hand a vector of one element through an If to a Range, which
wants scalars. Runtimes take it while the If hides the shape; folding would show it.

Given:   If -> n of shape [1] -> Range(0, n, 1)
Result:  If -> n -> Reshape to a scalar -> Range(0, n, 1)
"""

from collections.abc import Mapping

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import provenance
from me2e_compress.passes.fold_constants.inference import branch_fits
from me2e_compress.rewrite import add_constant


def seat_ranges(graph: ir.Graph, opsets: Mapping[str, int], by: str) -> int:
    """Make scalars of the bounds that an If would hand on as vectors; count them."""
    choices = [node for node in graph if node.op_type == "If"]
    return sum(_seat(node, graph, opsets, by) for node in choices)


def _seat(choice: ir.Node, graph: ir.Graph, opsets: Mapping[str, int], by: str) -> int:
    branches = [attribute.as_graph() for attribute in choice.attributes.values()]
    if all(branch_fits(choice, branch, opsets) for branch in branches):
        return 0
    bounds = [
        (use.node, use.idx, value)
        for value in choice.outputs
        for use in value.uses()
        if use.node.op_type == "Range" and use.node.graph is graph
    ]
    for node, index, value in bounds:
        shape = add_constant(graph, np.zeros(0, np.int64), f"{value.name}_shape")
        scalar = ir.node("Reshape", [value, shape], name=f"{node.name}_bound_{index}")
        scalar.outputs[0].name = f"{value.name}_scalar_{node.name}_{index}"
        scalar.outputs[0].type = value.type
        scalar.outputs[0].shape = ir.Shape([])
        provenance.inherit(scalar, [node], by=by)
        graph.insert_before(node, scalar)
        node.replace_input_with(index, scalar.outputs[0])
        provenance.inherit(node, [node], by=by)
    return len(bounds)
