"""Assign every node to a module: by its parameters, its scope, its neighbours."""

from collections.abc import Collection, Mapping, Sequence

import onnx_ir as ir

from me2e_compress.errors import ModuleMapError
from me2e_compress.graph.modules.assignment import Assignment, Placement
from me2e_compress.graph.modules.detect import behind_a_prefix
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.graph.modules.paths import parameter_path, scope_of
from me2e_compress.graph.nodes import has_subgraph
from me2e_compress.graph.provenance import MODULE


def assign(model: ir.Model, modules: ModuleMap) -> Assignment:
    """Find the module of every node, deterministically and in linear time.

    The first rule that applies decides:

    0. *stamp*: the node's own metadata, in a graph that was imported before;
    1. *parameter*: names of the initializers that reach it, directly or through
       arithmetic of constants alone (Transpose, Cast, Reshape of a weight); a MatMul
       whose weight lost its name goes by the bias added to it. An initializer that
       scopes of several modules read was merged by the exporter and decides nothing;
    2. *scope*: the torch module whose forward made it, see :func:`scope_of`;
    3. *neighbour*: the one module that all its results go to; else the nearest node
       that has a module, the producer first, then the consumer. Constants go by
       their consumers.

    Raises:
        ModuleMapError: a required pattern matches nothing, or none at all does.
    """
    # stamps of an earlier import
    nodes = list(model.graph.all_nodes())
    placed = {
        node: Placement(module, "stamp")
        for node in nodes
        if (module := node.metadata_props.get(MODULE)) in modules.names()
        and module is not None
    }
    scopes = {node: scope_of(node) for node in nodes}
    if not placed:
        _check(model, modules, scopes)
    # names of parameters, then scopes
    by_scope = {
        node: module
        for node, scope in scopes.items()
        if scope and (module := modules.match(scope)) is not None
    }
    constant = is_constant(nodes)
    for node, module in by_parameter(nodes, modules, by_scope, constant).items():
        placed.setdefault(node, Placement(module, "parameter"))
    for node, module in by_scope.items():
        placed.setdefault(node, Placement(module, "scope"))
    everywhere = modules.match("")
    if everywhere is not None:  # a pattern ``**``: what has no name is its too
        for node in nodes:
            placed.setdefault(node, Placement(everywhere, "scope"))
    # what is left goes by its neighbours
    known = {node: place.module for node, place in placed.items()}
    if nodes and not known:
        raise ModuleMapError(
            f"map {modules.name}: none of its patterns matches a parameter or a scope"
            f" of this graph, which has {_sample(model, scopes)}"
            f"{behind_a_prefix(modules, _every_path(model, scopes))}"
        )
    for node, module in _spread(nodes, known, constant).items():
        placed.setdefault(node, Placement(module, "neighbour"))
    return Assignment(modules, {node: placed[node] for node in nodes})


def _check(model: ir.Model, modules: ModuleMap, scopes: Mapping[ir.Node, str]) -> None:
    wanted = modules.required()
    if not wanted:
        return
    # each required pattern must match a parameter or a scope
    paths = _every_path(model, scopes)
    found = {claim for path in paths for claim in modules.claims(path)}
    for module, pattern in wanted:
        if (module, pattern) not in found:
            raise ModuleMapError(
                f"map {modules.name}: pattern {pattern!r} of module {module} matches"
                f" no parameter and no scope; there are {_sample(model, scopes)}"
                f"{behind_a_prefix(modules, paths)}"
            )


def _every_path(model: ir.Model, scopes: Mapping[ir.Node, str]) -> dict[str, None]:
    return dict.fromkeys(scopes.values()) | dict.fromkeys(_parameters(model))


def _sample(model: ir.Model, scopes: Mapping[ir.Node, str]) -> str:
    paths = [path for path in (*scopes.values(), *_parameters(model)) if path]
    tops = list(dict.fromkeys(".".join(path.split(".")[:2]) for path in paths))
    more = f" and {len(tops) - 8} more" if len(tops) > 8 else ""
    return ", ".join(tops[:8]) + more if tops else "no scopes and no named parameters"


def _parameters(model: ir.Model) -> list[str]:
    return [
        parameter_path(name) for graph in model.graphs() for name in graph.initializers
    ]


def _spread(
    nodes: Sequence[ir.Node],
    known: Mapping[ir.Node, str],
    constant: Collection[ir.Node],
) -> dict[ir.Node, str]:
    """Assign the nodes without a name of their own, in a few sweeps over the graph.

    1. A node whose results all end up in one module, whatever unnamed nodes they pass
       on the way, prepares that module's input and belongs to it.
    2. A node whose results go to several modules, or out of the graph, belongs to the
       module it gets its data from: of its producers, the one that comes last.
    3. What reads no data, as constants do, goes with the consumer that comes first.
    4. A node without such neighbours goes with the node before it (in a subgraph: with
       the node that holds it), at the very start with the one after.

    ``known`` must not be empty; ``constant`` nodes do not count as producers. Returns
    the module of every node, known ones included.
    """
    # sweep 1, then 2: from producers to consumers
    place = {node: index for index, node in enumerate(nodes)}
    found = dict(known) | _single_destinations(nodes, known)
    for node in nodes:
        if node in found or node in constant:
            continue
        makers = [value.producer() for value in node.inputs if value is not None]
        heard = [m for m in makers if m in found and m not in constant]
        if heard:
            found[node] = found[max(heard, key=place.__getitem__)]
    # sweep 3: from consumers to producers
    for node in reversed(nodes):
        heard = [reader for reader in _readers(node) if reader in found]
        if node not in found and heard:
            found[node] = found[min(heard, key=place.__getitem__)]
    # sweep 4: along the graph's order
    last = next(found[node] for node in nodes if node in found)
    for node in nodes:
        last = found.setdefault(node, last)
    return found


def _single_destinations(
    nodes: Sequence[ir.Node], known: Mapping[ir.Node, str]
) -> dict[ir.Node, str]:
    """Return the unknown nodes whose results all end up in one module."""
    goals: dict[ir.Node, str | None] = {}
    for node in reversed(nodes):
        if node in known:
            continue
        heard = {known.get(r) or goals.get(r): None for r in _readers(node)}
        outside = any(value.is_graph_output() for value in node.outputs)
        goals[node] = next(iter(heard)) if len(heard) == 1 and not outside else None
    return {node: module for node, module in goals.items() if module is not None}


def _readers(node: ir.Node) -> list[ir.Node]:
    return [reader for value in node.outputs for reader in value.consumers()]


def is_constant(nodes: Sequence[ir.Node]) -> frozenset[ir.Node]:
    """Return the nodes that compute from constants alone; nodes come in graph order."""
    found: set[ir.Node] = set()
    for node in nodes:
        if has_subgraph(node):
            continue
        if all(_known(value, found) for value in node.inputs if value is not None):
            found.add(node)
    return frozenset(found)


def by_parameter(
    nodes: Sequence[ir.Node],
    modules: ModuleMap,
    by_scope: Mapping[ir.Node, str],
    constant: Collection[ir.Node],
) -> dict[ir.Node, str]:
    """Return the module of every node that named parameters reach.

    Nodes come in graph order. ``by_scope`` is needed to recognise merged initializers.
    """
    # from initializers through constant arithmetic to the first nodes that compute
    claims: dict[ir.Value, str | None] = {}
    placed: dict[ir.Node, str] = {}
    for node in nodes:
        votes = [
            module
            for value in node.inputs
            if value is not None
            and (module := _claim(value, claims, modules, by_scope)) is not None
        ]
        votes = _copied(node, modules, constant) or votes
        if votes:
            placed[node] = votes[0]
        if node in constant:
            claims.update((value, placed.get(node)) for value in node.outputs)
    for node in nodes:
        if node not in placed and (bias := _bias_reader(node)) is not None:
            module = placed.get(bias)
            if module is not None:
                placed[node] = module
    return placed


def _copied(
    node: ir.Node, modules: ModuleMap, constant: Collection[ir.Node]
) -> list[str]:
    """Return the module of a parameter that is stored as a copy of an equal one.

    TorchScript's exporter writes parameters of equal values once, and the others as an
    Identity of it that has their name.
    """
    if node.op_type != "Identity" or node not in constant:
        return []
    module = modules.match(parameter_path(node.outputs[0].name))
    return [] if module is None else [module]


def _claim(
    value: ir.Value,
    claims: dict[ir.Value, str | None],
    modules: ModuleMap,
    by_scope: Mapping[ir.Node, str],
) -> str | None:
    if value in claims:
        return claims[value]
    module = None
    if value.is_initializer() and not value.is_graph_input():
        module = modules.match(parameter_path(value.name))
        if module is not None and _merged(value, by_scope):
            module = None
        claims[value] = module
    return module


def _merged(value: ir.Value, by_scope: Mapping[ir.Node, str]) -> bool:
    readers = [by_scope[node] for node in value.consumers() if node in by_scope]
    return any(module != readers[0] for module in readers)


def _bias_reader(node: ir.Node) -> ir.Node | None:
    if node.op_type != "MatMul" or node.outputs[0].is_graph_output():
        return None
    readers = node.outputs[0].consumers()
    return readers[0] if len(readers) == 1 and readers[0].op_type == "Add" else None


def _known(value: ir.Value, constant: Collection[ir.Node]) -> bool:
    producer = value.producer()
    if producer is None:
        return value.is_initializer() and not value.is_graph_input()
    return producer in constant
