"""Assign every node to a module, and count the weights and costs of each."""

import dataclasses
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Literal

import onnx_ir as ir

from me2e_compress.base.display import join_names
from me2e_compress.base.errors import ModuleMapError
from me2e_compress.graph.modules.module_map import (
    ModuleMap,
    parameter_path,
    presets,
    scope_of,
)
from me2e_compress.graph.nodes import has_subgraph
from me2e_compress.graph.provenance import MODULE
from me2e_compress.graph.summary import total_macs

Rule = Literal["stamp", "parameter", "scope", "neighbour"]


@dataclasses.dataclass(frozen=True)
class Placement:
    """The module of a node, and the rule that decided it."""

    module: str
    rule: Rule


@dataclasses.dataclass(frozen=True, repr=False)
class Assignment:
    """The module of every node of a graph and its subgraphs, in graph order."""

    modules: ModuleMap
    placements: Mapping[ir.Node, Placement]

    def module_of(self, node: ir.Node) -> str:
        """Return the module of a node of the graph that was assigned."""
        return self.placements[node].module

    def nodes(self, module: str) -> list[ir.Node]:
        """List a module's nodes in graph order."""
        return [n for n, place in self.placements.items() if place.module == module]

    def rules(self) -> dict[Rule, int]:
        """Count the nodes that each rule decided."""
        return dict(Counter(place.rule for place in self.placements.values()))


STACK = "me2e.stack"
"""Model metadata in which our exporters name the stack, e.g. ``vad-tiny``."""


def detect(model: ir.Model) -> ModuleMap:
    """Return the preset that fits a graph.

    The metadata ``me2e.stack`` name it (``vad-tiny`` is ``vad``); otherwise it is the
    one with the largest share of modules in the graph.

    Raises:
        ModuleMapError: no preset has half of its modules in the graph.
    """
    # The metadata decide
    stack = model.metadata_props.get(STACK, "")
    for name in presets():
        if f"{stack}-".startswith(f"{name}-"):
            return ModuleMap.load(name)
    # Otherwise the best fit
    scopes = {node: scope_of(node) for node in model.graph.all_nodes()}
    paths = [path for path in (*_parameters(model), *scopes.values()) if path]
    ranked = list[tuple[float, int, str]]()
    for name in presets():
        modules = ModuleMap.load(name)
        claims = [modules.match(path) for path in dict.fromkeys(paths)]
        claimed = [module for module in claims if module is not None]
        share = len({*claimed}) / len(modules.modules)
        # Of equal shares, the preset that matches most names
        ranked.append((-share, -len(claimed), name))
    share, _, best = min(ranked)
    if -share < 0.5:
        raise ModuleMapError(
            f"no module map fits this graph: {best} comes closest with"
            f" {-share:.0%} of its modules (presets: {', '.join(presets())});"
            " give a map file"
        )
    return ModuleMap.load(best)


def map_of(model: ir.Model, name: str | None) -> ModuleMap:
    """Load the preset or TOML file of a name, or the preset that fits."""
    if name is not None:
        return ModuleMap.load(name)
    try:
        return detect(model)
    except ModuleMapError:
        # A graph that no preset fits is one module, named `model`
        return ModuleMap.whole()


def assign(model: ir.Model, modules: ModuleMap) -> Assignment:
    """Find the module of every node, deterministically and in linear time.

    The first rule that applies decides: *stamp*, *parameter*, *scope*, *neighbour*.

    Raises:
        ModuleMapError: a required pattern matches nothing, or no pattern matches.
    """
    # Stamp: the metadata of the node, in a graph that was imported before
    nodes = list(model.graph.all_nodes())
    names = modules.names()
    placed = {
        node: Placement(module, "stamp")
        for node in nodes
        if (module := node.metadata_props.get(MODULE)) is not None and module in names
    }
    scopes = {node: scope_of(node) for node in nodes}
    paths = dict.fromkeys(scopes.values()) | dict.fromkeys(_parameters(model))
    # Required patterns must match, unless the graph was imported before
    required = [] if placed else modules.required()
    claims = {claim for path in paths if required for claim in modules.claims(path)}
    for module, pattern in required:
        if (module, pattern) not in claims:
            raise ModuleMapError(
                f"map {modules.name}: pattern {pattern!r} of module {module} matches"
                f" no parameter and no scope; there are {_sample(paths)}"
            )
    # Parameter: names of the initializers that reach the node, directly or through
    # constant arithmetic (Transpose, Cast, Reshape of a weight). Scope: the torch
    # module whose forward made it
    by_scope = {
        node: module
        for node, scope in scopes.items()
        if scope and (module := modules.match(scope)) is not None
    }
    constant = constant_nodes(nodes)
    for node, module in by_parameter(nodes, modules, by_scope, constant).items():
        placed.setdefault(node, Placement(module, "parameter"))
    for node, module in by_scope.items():
        placed.setdefault(node, Placement(module, "scope"))
    everywhere = modules.match("")
    if everywhere is not None:  # the pattern ``**`` takes nodes without a name, too
        for node in nodes:
            placed.setdefault(node, Placement(everywhere, "scope"))
    # Neighbour: the one module that reads all results; else that of the nearest node
    # with a module, the producer first, then the consumer
    known = {node: place.module for node, place in placed.items()}
    if nodes and not known:
        raise ModuleMapError(
            f"map {modules.name}: none of its patterns matches a parameter or a scope"
            f" of this graph, which has {_sample(paths)}"
        )
    for node, module in _spread(nodes, known, constant).items():
        placed.setdefault(node, Placement(module, "neighbour"))
    return Assignment(modules, {node: placed[node] for node in nodes})


def _sample(paths: Iterable[str]) -> str:
    tops = list(dict.fromkeys(".".join(path.split(".")[:2]) for path in paths if path))
    return join_names(tops, 8) or "no scopes and no named parameters"


def _parameters(model: ir.Model) -> list[str]:
    return [
        parameter_path(name) for graph in model.graphs() for name in graph.initializers
    ]


def _spread(
    nodes: Sequence[ir.Node],
    known: Mapping[ir.Node, str],
    constant: Collection[ir.Node],
) -> dict[ir.Node, str]:
    """Assign the nodes without a name to modules, in four sweeps over the graph.

    ``known`` must not be empty; ``constant`` nodes do not count as producers. Returns
    the module of every node, known ones included.
    """
    # 1. A node whose results are all read by one module, directly or through other
    # unnamed nodes, belongs to that module: it prepares its input
    place = {node: index for index, node in enumerate(nodes)}
    goals: dict[ir.Node, str | None] = {}
    for node in reversed(nodes):
        if node in known:
            continue
        readers = {known.get(r) or goals.get(r) for r in node.successors()}
        outside = any(value.is_graph_output() for value in node.outputs)
        goals[node] = readers.pop() if len(readers) == 1 and not outside else None
    modules = dict(known)
    modules |= {node: module for node, module in goals.items() if module is not None}
    # 2. Any other node belongs to the module of its last producer
    for node in nodes:
        makers = [m for m in node.predecessors() if m in modules and m not in constant]
        if node not in modules and node not in constant and makers:
            modules[node] = modules[max(makers, key=place.__getitem__)]
    # 3. A node without such a producer, as a constant, belongs to the module of its
    # first consumer
    for node in reversed(nodes):
        followers = [reader for reader in node.successors() if reader in modules]
        if node not in modules and followers:
            modules[node] = modules[min(followers, key=place.__getitem__)]
    # 4. A node without such neighbours belongs to the module of the node before it (in
    # a subgraph: of the node with the subgraph), the first nodes to that of the next
    last = next(modules[node] for node in nodes if node in modules)
    for node in nodes:
        last = modules.setdefault(node, last)
    return modules


def constant_nodes(nodes: Sequence[ir.Node]) -> frozenset[ir.Node]:
    """Return the nodes that compute from constants alone; nodes come in graph order."""
    constant: set[ir.Node] = set()
    for node in nodes:
        reads = [value for value in node.inputs if value is not None]
        others = [value for value in reads if value.producer() not in constant]
        if not has_subgraph(node) and all(
            value.is_initializer() and not value.is_graph_input() for value in others
        ):
            constant.add(node)
    return frozenset(constant)


def by_parameter(
    nodes: Sequence[ir.Node],
    modules: ModuleMap,
    by_scope: Mapping[ir.Node, str],
    constant: Collection[ir.Node],
) -> dict[ir.Node, str]:
    """Return the module of every node, in graph order, that named parameters reach."""
    # From initializers through constant arithmetic to the first nodes that compute
    claims: dict[ir.Value, str | None] = {}
    placed: dict[ir.Node, str] = {}
    for node in nodes:
        votes = [
            module
            for value in node.inputs
            if value is not None
            and (module := _claim(value, claims, modules, by_scope)) is not None
        ]
        # A parameter that equals another: TorchScript's exporter writes the first, and
        # the others as an Identity of that under their names
        if node.op_type == "Identity" and node in constant:
            copy = modules.match(parameter_path(node.outputs[0].name))
            votes = votes if copy is None else [copy]
        if votes:
            placed[node] = votes[0]
        if node in constant:
            claims.update((value, placed.get(node)) for value in node.outputs)
    # A MatMul whose weight lost its name belongs to the module of the added bias
    for node in nodes:
        if node in placed or node.op_type != "MatMul":
            continue
        readers = node.outputs[0].consumers()
        alone = len(readers) == 1 and not node.outputs[0].is_graph_output()
        if alone and readers[0].op_type == "Add" and readers[0] in placed:
            placed[node] = placed[readers[0]]
    return placed


def _claim(
    value: ir.Value,
    claims: dict[ir.Value, str | None],
    modules: ModuleMap,
    by_scope: Mapping[ir.Node, str],
) -> str | None:
    if value in claims or not value.is_initializer() or value.is_graph_input():
        return claims.get(value)
    # An initializer that scopes of several modules read was merged
    scopes = {by_scope[node] for node in value.consumers() if node in by_scope}
    named = modules.match(parameter_path(value.name))
    claims[value] = None if len(scopes) > 1 else named
    return claims[value]


# Types of shapes, indices, masks and texts
_NOT_WEIGHTS = (
    ir.DataType.INT64, ir.DataType.INT32, ir.DataType.BOOL, ir.DataType.STRING,
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Item:
    """The nodes, weights and cost of one module; None is not counted.

    Attributes:
        nodes: number of nodes, with those in subgraphs.
        parameters: elements of weights: initializers, but those of int32, int64, bool
            and string, which are shapes, indices and masks.
        weight_bytes: of all initializers.
        macs: known multiply-accumulates: a lower bound if others are unknown, and then
            None instead of 0.
        unknown_macs_nodes: number of its nodes that are not in ``macs``.
    """

    module: str
    nodes: int
    parameters: int
    weight_bytes: int
    macs: int | None
    unknown_macs_nodes: int | None


def itemise(
    model: ir.Model,
    modules: ModuleMap,
    module_of: Callable[[ir.Node], str],
    macs: Callable[[ir.Node], int | None] | None = None,
) -> tuple[Item, ...]:
    """Count each module, in the order of the map; modules without nodes are zeros."""
    nodes: dict[str, list[ir.Node]] = {name: [] for name in modules.names()}
    for node in model.graph.all_nodes():
        nodes.setdefault(module_of(node), []).append(node)
    # An initializer counts once: for the module that its name says, else for the first
    # node that reads it. One that nothing reads and no name places counts nowhere
    elements, size = dict.fromkeys(nodes, 0), dict.fromkeys(nodes, 0)
    for graph in (model.graph, *model.graph.subgraphs()):
        for value in graph.initializers.values():
            tensor, readers = value.const_value, value.consumers()
            owner = modules.match(parameter_path(value.name))
            if owner is None and readers:
                owner = module_of(readers[0])
            if owner is None or tensor is None:
                continue
            size[owner] = size.get(owner, 0) + tensor.nbytes
            if tensor.dtype not in _NOT_WEIGHTS:
                elements[owner] = elements.get(owner, 0) + tensor.size
    items = list[Item]()
    for module, own in nodes.items():
        counts = (None, None) if macs is None else total_macs(map(macs, own))
        items.append(Item(module, len(own), elements[module], size[module], *counts))
    return tuple(items)
