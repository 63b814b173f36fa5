"""Cut a part out of a graph, to be run alone."""

from collections.abc import Sequence

import onnx_ir as ir


def part_of(
    model: ir.Model, inputs: Sequence[ir.Value], outputs: Sequence[ir.Value]
) -> ir.Model:
    """Return the nodes between some values of a graph as a model of their own.

    Weights, functions and opsets come along. ValueError where the outputs need more
    than these inputs.
    """
    body = ir.convenience.extract(model.graph, inputs, outputs)
    body.opset_imports.update(model.graph.opset_imports)
    return ir.Model(
        body,
        ir_version=model.ir_version,
        functions=[function.clone() for function in model.functions.values()],
    )
