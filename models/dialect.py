"""Write the fused nodes of an exported graph in the form of a plugin library."""

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.graph import rewrite
from me2e_compress.operators import dialect_of, fused_nodes, import_domains, translate
from me2e_compress.passes.fold_constants.knowledge import Sweep
from me2e_compress.passes.import_normalize import with_own_domains


def in_dialect(model: ir.Model, dialect: str) -> ir.Model:
    """Write the fused nodes of a graph in a dialect, with the shapes of their outputs.

    A dialect that cannot express one of them raises PreconditionError.
    """
    _record_shapes(model)
    # plugins tell no shapes, so that these were recorded above
    for fused in fused_nodes(model):
        to = dialect_of(fused.operator, dialect)
        if to is not None and to != fused.dialect:
            translate(fused.node, to, opset=fused.opset, by="export", names=fused.names)
    import_domains(model)
    rewrite.sweep(model)
    graph.infer_shapes(model)
    return with_own_domains(model)


def _record_shapes(model: ir.Model) -> None:
    """Record the shapes that shape arithmetic gives; the nodes stay as they are."""
    # fold and infer in a copy until no more shapes become known
    copy = model.clone()
    rewrite.lift_constants(copy)
    left, before = _unshaped(copy), -1
    while left != before:
        before = left
        graph.infer_shapes(copy)
        sweep = Sweep(
            graph.opset_of(copy), set(), set(), through_compute=False, trust_shapes=True
        )
        sweep.visit_nodes(copy.graph)
        left = _unshaped(copy)
    # write the shapes back, by name
    known = {value.name: value for node in copy.graph for value in node.outputs}
    for node in model.graph:
        for value in node.outputs:
            found = known.get(value.name)
            if found is not None and not value.is_graph_output():
                value.shape, value.type = found.shape, found.type


def _unshaped(model: ir.Model) -> int:
    values = (value for node in model.graph for value in node.outputs)
    return sum(graph.static_shape(value) is None for value in values)
