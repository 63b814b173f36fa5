"""Cut one graph into the parts of the stack that it was joined from."""

from collections.abc import Mapping

import onnx_ir as ir

from me2e_compress.errors import GraphError
from me2e_compress.graph.nodes import STANDARD, nodes_of, reads_of
from me2e_compress.graph.stack.joints import Joints, Names
from me2e_compress.graph.stack.part_graph import PartGraph


def split(
    model: ir.Model, joints: Joints, names: Names, before: Mapping[str, str]
) -> dict[str, ir.Model]:
    """Return the graph of every part of a joined graph that passes changed.

    A part is what computes its outputs from its inputs, both under the names that its
    file has: whoever runs the files one by one can go on. A constant that two parts
    read stands in both. Inputs and outputs that a pass took away are missing, and so is
    a part without any output. ``before`` is the metadata of the joined graph as it was
    read: what is new in it since is written into every part.

    Raises:
        GraphError: a part would need what another part computes and does not give.
    """
    added = {
        key: text
        for key, text in model.metadata_props.items()
        if before.get(key) != text
    }
    found = dict[str, ir.Model]()
    for part, file in joints.graphs.items():
        values = _values(model.graph)
        fed = {
            name: values[public]
            for name, source in joints.sources[part].items()
            if (public := names.public(*source) if source.part else source.name)
            in values
        }
        given = {
            name: values[public]
            for name in file.outputs
            if (public := names.public(part, name)) in values
            and name not in file.inputs  # else it is passed on
        }
        if not given:
            continue
        cut = _cut(model, file, fed, given)
        cut.metadata_props.update({**file.metadata, **added})
        found[part] = cut
    return found


def _values(graph: ir.Graph) -> dict[str, ir.Value]:
    """Return the graph's inputs and outputs by name."""
    return {str(value.name): value for value in (*graph.inputs, *graph.outputs)}


def _cut(
    model: ir.Model,
    file: PartGraph,
    fed: Mapping[str, ir.Value],
    given: Mapping[str, ir.Value],
) -> ir.Model:
    """Copy what lies between a part's inputs and its outputs."""
    borders = list(dict.fromkeys(fed.values()))
    nodes, weights = _between(model.graph, file, borders, list(given.values()))
    view = ir.GraphView(
        borders,
        list(given.values()),
        nodes=nodes,
        initializers=weights,
        opset_imports=model.opset_imports,
        name=file.part,
    )
    graph = view.clone()
    _rename(graph, file, fed, given)
    copy = ir.Model(graph, ir_version=model.ir_version)
    _declare(copy, model)
    return copy


def _between(
    graph: ir.Graph, file: PartGraph, borders: list[ir.Value], given: list[ir.Value]
) -> tuple[list[ir.Node], list[ir.Value]]:
    """List the nodes and weights that compute some outputs, in the graph's order."""
    needed, weights = set[ir.Node](), dict[ir.Value, None]()
    stops, waiting = set(borders), list(given)
    while waiting:
        value = waiting.pop()
        node = value.producer()
        if value in stops:
            continue
        if value.is_initializer():
            weights[value] = None
        elif node is None:
            raise GraphError(
                f"{file.part} cannot be cut out again: a pass made it need"
                f" {value.name}, which {file.path.name} does not take"
            )
        elif node not in needed:
            needed.add(node)
            waiting += reads_of(node)
    return [node for node in graph if node in needed], list(weights)


def _rename(
    graph: ir.Graph,
    file: PartGraph,
    fed: Mapping[str, ir.Value],
    given: Mapping[str, ir.Value],
) -> None:
    """Give inputs and outputs the names of the part's file, in its order."""
    places = {value: at for at, value in enumerate(dict.fromkeys(fed.values()))}
    copies = list(graph.inputs)
    kinds = {str(value.name): value for value in file.model.graph.inputs}
    inputs, seen = list[ir.Value](), set[ir.Value]()
    others = {
        str(value.name): value
        for value in (
            *graph.initializers.values(),
            *(value for node in graph for value in node.outputs),
        )
    }
    for value, name in zip(graph.outputs, given, strict=True):
        _give_way(others, name, value)
        value.name = name
    for name, source in fed.items():
        value = copies[places[source]]
        if value in seen:  # one output feeds two inputs of a part
            kind = kinds[name]
            value = ir.Value(name=name, type=kind.type, shape=kind.shape)
        seen.add(value)
        _give_way(others, name, value)
        value.name = name
        inputs.append(value)
    graph.inputs[:] = inputs
    ends = {str(value.name): value for value in (*inputs, *graph.outputs)}
    graph.outputs[:] = [ends[name] for name in file.outputs if name in ends]


def _give_way(others: Mapping[str, ir.Value], name: str, value: ir.Value) -> None:
    """Rename an inner value that stands in the way of a name of the file."""
    other = others.get(name)
    if other is None or other is value:
        return
    free = f"{name}_"
    while free in others:
        free += "_"
    other.name = free


def _declare(copy: ir.Model, model: ir.Model) -> None:
    """Keep the functions that are called, and import the domains that are used."""
    functions = dict(model.functions)
    called = {node.op_identifier() for node in copy.graph.all_nodes()} & {*functions}
    waiting = list(called)
    while waiting:
        inner = {node.op_identifier() for node in functions[waiting.pop()].all_nodes()}
        new = (inner & {*functions}) - called
        called |= new
        waiting += new
    for key in functions:
        if key in called:
            copy.functions[key] = functions[key].clone()
    used = {node.domain for node in nodes_of(copy)}
    for domain in list(copy.opset_imports):
        if domain not in used and domain not in STANDARD:
            del copy.opset_imports[domain]
