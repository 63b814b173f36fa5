"""Convert to onnx-graphsurgeon, and back without losing anything.

``gs.Graph`` holds no metadata, so a graph that was out is restored from the one that
it was made of. In graphsurgeon, call ``fold_constants(recurse_functions=False)`` and
``cleanup(recurse_functions=False)``: with their defaults they rewrite function bodies
as if these were graphs of their own, and the model is not valid any more (0.6.1).
"""

import onnx_graphsurgeon as gs
import onnx_ir as ir
from onnx_graphsurgeon.util.exception import OnnxGraphSurgeonException

from me2e_compress.errors import GraphError
from me2e_compress.graph.restore import restore


def to_graphsurgeon(model: ir.Model) -> gs.Graph:
    """Return a model as a ``gs.Graph`` of its own; the model stays as it is.

    Weights are read into memory. graphsurgeon knows no overloads, so the second
    function of a name is called ``name__overload`` there.
    """
    copy = model.clone()
    for graph in (copy.graph, *copy.graph.subgraphs()):
        for value in graph.initializers.values():
            if isinstance(value.const_value, ir.ExternalTensor):
                array = value.const_value.numpy().copy()
                value.const_value = ir.tensor(array, name=value.name)
    _rename(copy, {key: _spelled(key) for key in copy.functions if key[2]})
    return gs.import_onnx(ir.to_proto(copy))


def from_graphsurgeon(
    gs_graph: gs.Graph, like: ir.Model, *, by: str = "graphsurgeon"
) -> ir.Model:
    """Return the model of a ``gs.Graph``, with the metadata of the one it came from.

    Its nodes may be in any order. ``like`` was given to :func:`to_graphsurgeon`, ``by``
    is the pass to name in the provenance of new nodes.

    Raises:
        GraphError: the graph has a cycle, or an input or output without a type.
    """
    try:
        model: ir.Model = ir.from_proto(gs.export_onnx(gs_graph))
        model.graph.sort()
    except (OnnxGraphSurgeonException, ValueError) as error:
        reason = " ".join(str(error).split())
        raise GraphError(f"{by}: graphsurgeon's graph is not a model: {reason}") from (
            error
        )
    _rename(model, {_spelled(key): key for key in like.functions if key[2]})
    restore(model, like, by=by)
    return model


def _spelled(key: ir.OperatorIdentifier) -> ir.OperatorIdentifier:
    domain, name, overload = key
    return domain, f"{name}__{overload}", ""


def _rename(
    model: ir.Model, names: dict[ir.OperatorIdentifier, ir.OperatorIdentifier]
) -> None:
    if not names:
        return
    functions = list(model.functions.values())
    for nodes in (model.graph.all_nodes(), *(f.all_nodes() for f in functions)):
        for node in nodes:
            if (new := names.get(node.op_identifier())) is not None:
                node.domain, node.op_type, node.overload = new
    model.functions.clear()
    for function in functions:
        if (new := names.get(function.identifier())) is not None:
            function.domain, function.name, function.overload = new
        model.functions[function.identifier()] = function
