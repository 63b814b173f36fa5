"""Convert to onnx-graphsurgeon, and back without losing anything.

``gs.Graph`` has no metadata, so these are restored from the graph that was converted.
In graphsurgeon, call ``fold_constants(recurse_functions=False)`` and
``cleanup(recurse_functions=False)``: with their defaults they rewrite function bodies
as if these were graphs, and the model becomes invalid (0.6.1).
"""

from collections.abc import Iterable, Sequence

import onnx_graphsurgeon as gs
import onnx_ir as ir
from onnx_graphsurgeon.util.exception import OnnxGraphSurgeonException

from me2e_compress.base.errors import GraphError
from me2e_compress.graph import provenance
from me2e_compress.graph.files import inlined


def restore(
    model: ir.Model, like: ir.Model, *, by: str, node_names: bool = False
) -> None:
    """Restore metadata and provenance in a graph that a tool has rewritten.

    onnxsim and onnx-graphsurgeon drop the metadata of models, functions, nodes and
    values. The time is linear in nodes.

    Args:
        model: the tool's result, in graph order; changed in place.
        like: the tool's input.
        by: the pass to name in the provenance of new nodes.
        node_names: restore the names of recognized nodes of the same operator too.
    """
    # Metadata of the model
    model.domain, model.doc_string = like.domain, like.doc_string
    model.model_version = like.model_version
    _add_missing(model.metadata_props, like.metadata_props)
    _add_missing(model.graph.metadata_props, like.graph.metadata_props)
    # Functions, and values by their names
    for key, function in model.functions.items():
        if key in like.functions:
            _add_missing(function.metadata_props, like.functions[key].metadata_props)
            _match(list(function.all_nodes()), list(like.functions[key].all_nodes()))
    past = {value.name: value.metadata_props for value in _values(like)}
    for value in _values(model):
        _add_missing(value.metadata_props, past.get(value.name, {}))
    # Recognized nodes, then new ones
    nodes = list(model.graph.all_nodes())
    known = _match(nodes, list(like.graph.all_nodes()))
    if node_names:
        names = {n: p.name for n, p in known.items() if p.name and _alike(n, p)}
        used = {node.name for node in nodes if node not in names}
        for node, name in names.items():
            if name not in used:
                used.add(name)
                node.name = name
    _inherit_from_neighbours(nodes, known, by)


def _add_missing(props: dict[str, str], past: dict[str, str]) -> None:
    props.update({key: text for key, text in past.items() if key not in props})


def _values(model: ir.Model) -> Iterable[ir.Value]:
    for graph in (model.graph, *model.graph.subgraphs()):
        yield from graph.inputs
        yield from graph.initializers.values()
    for node in model.graph.all_nodes():
        yield from node.outputs


def _match(nodes: Sequence[ir.Node], past: Sequence[ir.Node]) -> dict[ir.Node, ir.Node]:
    by_output = {node.outputs[0].name: node for node in past if node.outputs}
    by_name = {node.name: node for node in past if node.name}
    matches: dict[ir.Node, ir.Node] = {}
    for node in nodes:
        # A node is recognized by the name of its first output, then by its own name
        known = by_output.get(node.outputs[0].name) if node.outputs else None
        if known is None and node.name:
            named = by_name.get(node.name)
            known = named if named is not None and _alike(named, node) else None
        if known is not None:
            matches[node] = known
            if _alike(node, known):
                _add_missing(node.metadata_props, known.metadata_props)
    return matches


def _alike(one: ir.Node, other: ir.Node) -> bool:
    return one.op_identifier() == other.op_identifier()


def _inherit_from_neighbours(
    nodes: Sequence[ir.Node], matches: dict[ir.Node, ir.Node], by: str
) -> None:
    # A node of another operator inherits from the old node and removed ones above that
    alive = {value.name for node in nodes for value in node.outputs}
    claimed: set[ir.Node] = set()
    for node in nodes:
        if provenance.read(node) is None and (known := matches.get(node)) is not None:
            vanished = _vanished_above(known, alive, claimed)
            provenance.inherit(node, (known, *vanished), by=by)
    # A new node inherits from its nearest neighbour: the producer that comes last in
    # the graph, else the consumer that comes first
    place = {node: index for index, node in enumerate(nodes)}
    for node in nodes:
        makers = [m for m in node.predecessors() if m in place and provenance.read(m)]
        if provenance.read(node) is None and makers:
            provenance.inherit(node, (max(makers, key=place.__getitem__),), by=by)
    # Consumers, for nodes without such a producer
    for node in reversed(nodes):
        readers = [reader for reader in node.successors() if provenance.read(reader)]
        if provenance.read(node) is None and readers:
            provenance.inherit(node, (min(readers, key=place.__getitem__),), by=by)


def _vanished_above(
    node: ir.Node, alive: set[str | None], claimed: set[ir.Node]
) -> list[ir.Node]:
    vanished: list[ir.Node] = []
    stack = [node]
    while stack:
        for value in stack.pop().inputs:
            maker = None if value is None else value.producer()
            if maker is None or maker in claimed:
                continue
            if not any(output.name in alive for output in maker.outputs):
                claimed.add(maker)
                vanished.append(maker)
                stack.append(maker)
    return vanished


def to_graphsurgeon(model: ir.Model) -> gs.Graph:
    """Return a model as a ``gs.Graph`` of its own, its weights in memory.

    A function that is an overload, which graphsurgeon does not know, is a GraphError.
    """
    if overloads := [name for _, name, overload in model.functions if overload]:
        raise GraphError(f"graphsurgeon knows no overloads, as of {overloads[0]}")
    return gs.import_onnx(ir.to_proto(inlined(model)))


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
    restore(model, like, by=by)
    return model
