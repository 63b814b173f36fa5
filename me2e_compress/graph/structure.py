"""What a file must hold to be a graph: checked once, when it is read.

ONNX's own checker knows neither plugins in the default domain nor weights on disk, and
what runs later (shape inference, cloning, passes) trusts what it is given. So all that
they trust is checked here, and nowhere else.
"""

import itertools
from collections import Counter
from collections.abc import Collection, Iterable, Sequence

import onnx

from me2e_compress.errors import GraphError
from me2e_compress.graph.declared import (
    check_attributes,
    check_call,
    check_port,
    check_signature,
    check_tensor,
    check_text,
)

LARGEST_VERSION = 2**31 - 1
DEEPEST = 32
"""Graphs in nodes of graphs: protobuf itself ends at about thirty. Calls of functions
in functions likewise: what walks through them goes as deep."""
MOST_CALLED_NODES = 1_000_000
"""Nodes of a graph in which every call stands for what its function holds: ONNX's
inference goes through all of them."""

Names = Collection[str]


def check(model: onnx.ModelProto) -> bool:
    """Check a model as it was read, weights apart.

    Returns:
        Whether every node comes after those that make its inputs; if not, the nodes
        have an order all the same, or sorting them finds a cycle.

    Raises:
        GraphError: names what is missing, doubled, unknown or of another kind, without
            the file.
    """
    _check_opsets(model)
    if not model.graph.output:
        raise GraphError("not an ONNX model (no outputs)")
    check_text("metadata", (p for e in model.metadata_props for p in (e.key, e.value)))
    check_text("model", (model.producer_name, model.doc_string, model.domain))
    versions = {each.domain: each.version for each in model.opset_import}
    functions = {(f.domain, f.name, f.overload): f for f in model.functions}
    if len(functions) < len(model.functions):
        raise GraphError("two of its functions have one name")
    _check_calls(model.graph, functions)
    walk = _Walk(versions, functions)
    walk.main(model.graph)
    for function in model.functions:
        walk.function(function)
    return walk.in_order


def _check_opsets(model: onnx.ModelProto) -> None:
    if not model.opset_import:
        raise GraphError("not an ONNX model (no opset)")
    if not 1 <= model.ir_version <= LARGEST_VERSION:
        raise GraphError(f"IR version {model.ir_version} is none")
    for imports in (model.opset_import, *(f.opset_import for f in model.functions)):
        check_text("opset", (each.domain for each in imports))
        for each in imports:
            if not 1 <= each.version <= LARGEST_VERSION:
                raise GraphError(f"opset {each.version} of {each.domain or 'ai.onnx'}")
        if len({each.domain for each in imports}) < len(imports):
            raise GraphError("two opsets of one domain")


Function = tuple[str, str, str]


def _check_calls(
    graph: onnx.GraphProto, functions: dict[Function, onnx.FunctionProto]
) -> None:
    """Refuse functions that nothing can inline: in a circle, too deep or too many."""

    def size(nodes: Iterable[onnx.NodeProto]) -> int:
        names = (
            (each.domain, each.op_type, each.overload) for each in _all_nodes(nodes)
        )
        return sum(sizes.get(name, 1) for name in names)

    sizes: dict[Function, int] = {}
    calls = {
        name: {
            called
            for node in _all_nodes(function.node)
            if (called := (node.domain, node.op_type, node.overload)) in functions
        }
        for name, function in functions.items()
    }
    for depth in itertools.count():
        leaves = [name for name, called in calls.items() if not called & calls.keys()]
        if not leaves:
            break
        if depth > DEEPEST:
            raise GraphError(f"functions call each other more than {DEEPEST} deep")
        for name in leaves:
            del calls[name]
            sizes[name] = size(functions[name].node)
    if calls:
        first = min(calls)[1]
        raise GraphError(f"function {first} calls itself, at once or over others")
    if (found := size(graph.node)) > MOST_CALLED_NODES:
        raise GraphError(
            f"its functions make {found:,} nodes of it, {MOST_CALLED_NODES:,} at most"
            " are read"
        )


def _all_nodes(nodes: Iterable[onnx.NodeProto]) -> Iterable[onnx.NodeProto]:
    for node in nodes:
        yield node
        for attribute in node.attribute:
            for body in (attribute.g, *attribute.graphs):
                yield from _all_nodes(body.node)


class _Walk:
    """Goes through every graph of a model, with the names that are known there.

    Args:
        versions: opset of every domain.
        functions: the model's own.
    """

    def __init__(
        self,
        versions: dict[str, int],
        functions: dict[Function, onnx.FunctionProto],
    ) -> None:
        self.versions, self.functions = versions, functions
        self.in_order = True

    def main(self, body: onnx.GraphProto) -> None:
        """Check the graph itself: its inputs say what they are."""
        given = {each.name for each in body.initializer}
        for each in body.input:
            if each.name not in given:
                check_port(each, typed=True)
        for each in (*body.output, *body.value_info):
            check_port(each, typed=False)
        self.graph(body, frozenset(), 0)

    def function(self, function: onnx.FunctionProto) -> None:
        """Check a function."""
        where = f"function {function.name}"
        check_text("function", (function.name, function.domain, function.doc_string))
        if not function.name or not function.output or not function.node:
            raise GraphError(f"{where} has no name, no output or no node")
        _unique(f"{where}: input", function.input)
        local = {each.domain: each.version for each in function.opset_import}
        inside = _Walk({**self.versions, **local}, self.functions)
        known = inside.nodes(where, function.node, function.input, frozenset(), 0, True)
        _made(f"{where}: output", function.output, known)
        self.in_order = self.in_order and inside.in_order

    def graph(self, body: onnx.GraphProto, outside: Names, depth: int) -> None:
        """Check a graph, in which the names of the graphs around it are known."""
        if depth > DEEPEST:
            raise GraphError(f"graphs are nested more than {DEEPEST} deep")
        where = f"graph {body.name!r}" if depth else "graph"
        if body.sparse_initializer:
            name = body.sparse_initializer[0].values.name
            raise GraphError(f"initializer {name!r} is sparse: write it as a dense one")
        check_text(where, (body.name, body.doc_string))
        names = [each.name for each in body.initializer]
        ports = [each.name for each in body.input]
        _unique(f"{where}: input", ports)
        _unique(f"{where}: initializer", names)
        for tensor in body.initializer:
            check_tensor(tensor)
        begin = (*ports, *(name for name in names if name not in set(ports)))
        known = self.nodes(where, body.node, begin, outside, depth, False)
        _unique(f"{where}: output", [each.name for each in body.output])
        _made(f"{where}: output", (each.name for each in body.output), known)

    def nodes(
        self,
        where: str,
        nodes: Sequence[onnx.NodeProto],
        begin: Sequence[str],
        outside: Names,
        depth: int,
        in_function: bool,
    ) -> Names:
        """Check nodes; return every name that is known behind the last."""
        made = dict.fromkeys(begin, "an input or initializer")
        for node in nodes:
            check_text("node", (node.name, node.op_type, node.domain, node.doc_string))
            label = node.name or f"of {node.op_type}"
            if not node.op_type or not any(node.output):
                raise GraphError(
                    f"{where}: node {label!r} has no operator or no output"
                )
            for name in filter(None, node.output):
                if name in made:
                    raise GraphError(
                        f"{where}: {name!r} is made twice: by node {label!r} and by"
                        f" {made[name]}"
                    )
                made[name] = f"node {label!r}"
        reachable = made.keys() | outside
        before = {*begin, *outside}
        for node in nodes:
            self._node(node, reachable, before, depth, in_function)
            before.update(node.output)
        return made.keys()

    def _node(
        self,
        node: onnx.NodeProto,
        reachable: Names,
        before: Names,
        depth: int,
        in_function: bool,
    ) -> None:
        for name in filter(None, node.input):
            if name not in reachable:
                raise GraphError(
                    f"node {node.name!r} reads {name!r}, which nothing makes"
                )
            self.in_order = self.in_order and name in before
        check_attributes(node, in_function=in_function)
        called = self.functions.get((node.domain, node.op_type, node.overload))
        if called is None:
            check_signature(node, self.versions)
        else:
            check_call(node, called)
        for each in node.metadata_props:
            check_text("metadata of a node", (each.key, each.value))
        for attribute in node.attribute:
            own = (attribute.t,) if attribute.HasField("t") else ()
            for tensor in (*own, *attribute.tensors):
                check_tensor(tensor, f"the tensor of node {node.name!r}")
            for body in _bodies(attribute):
                self.graph(body, reachable, depth + 1)


def _bodies(attribute: onnx.AttributeProto) -> tuple[onnx.GraphProto, ...]:
    own = (attribute.g,) if attribute.HasField("g") else ()
    return (*own, *attribute.graphs)


def _unique(what: str, names: Iterable[str]) -> None:
    listed = list(names)
    check_text(what, listed)
    if "" in listed:
        raise GraphError(f"{what} without a name")
    if len(set(listed)) < len(listed):
        twice = next(name for name, count in Counter(listed).items() if count > 1)
        raise GraphError(f"{what} {twice!r} is there twice")


def _made(what: str, names: Iterable[str], known: Names) -> None:
    for name in names:
        if name not in known:
            raise GraphError(f"{what} {name!r}: nothing makes it")
