"""Merge the graphs of a stack's parts into one."""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping

import onnx_ir as ir

from me2e_compress.errors import GraphError
from me2e_compress.graph.nodes import STANDARD, graphs_of, nodes_of, opset_of
from me2e_compress.graph.opset import newer
from me2e_compress.graph.stack.joints import FeedSource, Joints, Names
from me2e_compress.graph.stack.part_graph import PartGraph


def merged(joints: Joints, names: Names, inputs: Collection[str]) -> ir.Model:
    """Return one graph of all parts.

    Its inputs are those of the stack, its outputs all that a part gives, by their names
    in the stack. Other names that two parts have get the part in
    front: ``head.w``, and ``/head/Mul`` for ``/Mul``. Weights are shared with the
    files' graphs, not copied.
    """
    models = {part: each.model.clone() for part, each in joints.graphs.items()}
    _write_one_opset(joints, models)
    functions = _functions(models)
    public = {
        names.public(part, output)
        for part, each in joints.graphs.items()
        for output in each.outputs
    }
    _keep_apart(models, public | set(inputs))
    body = _Body(joints, names)
    for part in joints.order:
        body.add(part, models[part].graph)
    imports = {
        domain: version
        for model in models.values()
        for domain, version in model.opset_imports.items()
    }
    joined = ir.Model(
        ir.Graph(
            [body.taken[name] for name in inputs],
            body.outputs(),
            nodes=body.nodes,
            initializers=body.initializers,
            opset_imports=imports,
            name="stack",
        ),
        ir_version=max(each.ir_version for each in models.values()),
        functions=functions,
    )
    joined.graph.sort()
    return joined


class _Body:
    """The nodes and values of the merged graph, part by part."""

    def __init__(self, joints: Joints, names: Names) -> None:
        self.joints, self.names = joints, names
        self.nodes = list[ir.Node]()
        self.initializers = list[ir.Value]()
        self.taken = dict[str, ir.Value]()
        self._given = dict[FeedSource, ir.Value]()

    def add(self, part: str, graph: ir.Graph) -> None:
        """Move a part's nodes here; its inputs become what feeds them."""
        file = self.joints.graphs[part]
        inputs, outputs = list(graph.inputs), list(graph.outputs)
        # what is passed on without a node could not have a name of its own
        given = [_named(graph, value, file, outputs) for value in outputs]
        nodes = list(graph)
        self.initializers += graph.initializers.values()
        graph.inputs.clear()
        graph.outputs.clear()
        graph.initializers.clear()
        graph.remove(nodes)
        self.nodes += nodes
        for value, name in zip(inputs, file.inputs, strict=True):
            source = self.joints.sources[part][name]
            if source.part:
                known = self._given[source]
            else:
                value.name = source.name
                known = self.taken.setdefault(source.name, value)
            if known is not value:
                ir.convenience.replace_all_uses_with(value, known)
        for value, name in zip(given, file.outputs, strict=True):
            value.name = self.names.public(part, name)
            self._given[FeedSource(part, name)] = value

    def outputs(self) -> list[ir.Value]:
        """Return what the parts give, in the order of the stack's file."""
        return [
            self._given[FeedSource(part, name)]
            for part, each in self.joints.graphs.items()
            for name in each.outputs
        ]


def _named(
    graph: ir.Graph, value: ir.Value, file: PartGraph, outputs: list[ir.Value]
) -> ir.Value:
    """Return the value of an output, behind an Identity where no node gives it."""
    if outputs.count(value) > 1:
        raise GraphError(f"{file.path}: output {value.name} is listed twice")
    if value.producer() is not None:
        return value
    node = ir.node("Identity", [value], name=f"{value.name}/passed_on")
    (copy,) = node.outputs
    copy.type, copy.shape = value.type, value.shape
    graph.append(node)
    return copy


def _keep_apart(models: Mapping[str, ir.Model], public: Collection[str]) -> None:
    """Put the part in front of names of values and nodes that others have too."""
    values = {part: list(_inner_values(each)) for part, each in models.items()}
    nodes = {
        part: [each for body in graphs_of(model.graph) for each in body]
        for part, model in models.items()
    }
    for named, reserved in ((values, public), (nodes, ())):
        seen = Counter(
            name
            for each in named.values()
            for name in {item.name for item in each if item.name}
        )
        used = {*seen, *reserved}
        for part, each in named.items():
            known = dict[str, str]()
            for item in each:
                name = item.name
                if name and (seen[name] > 1 or name in reserved):
                    if name not in known:
                        known[name] = _free(part, name, used)
                    item.name = known[name]


def _free(part: str, name: str, used: set[str]) -> str:
    found = f"/{part}{name}" if name.startswith("/") else f"{part}.{name}"
    while found in used:
        found += "_"
    used.add(found)
    return found


def _inner_values(model: ir.Model) -> Iterator[ir.Value]:
    """Yield every value but the graph's own inputs and outputs."""
    ends = {*model.graph.inputs, *model.graph.outputs}
    for body in graphs_of(model.graph):
        made = (value for node in body for value in node.outputs)
        for value in (*body.inputs, *list(body.initializers.values()), *made):
            if value not in ends:
                yield value


def _functions(models: Mapping[str, ir.Model]) -> list[ir.Function]:
    """Collect the functions; one that differs from another's is renamed."""
    found = dict[ir.OperatorIdentifier, ir.Function]()
    for part, model in models.items():
        for key, function in list(model.functions.items()):
            other = found.setdefault(key, function)
            if other is function or _text(other) == _text(function):
                continue
            name = f"{function.name}_{part}"
            for node in nodes_of(model):
                if node.op_identifier() == key:
                    node.op_type = name
            function.name = name
            found[function.identifier()] = function
    return list(found.values())


def _text(function: ir.Function) -> bytes:
    return ir.serde.serialize_function(function).SerializeToString(deterministic=True)


def _write_one_opset(joints: Joints, models: Mapping[str, ir.Model]) -> None:
    """Write every part in the newest opset of all, or refuse."""
    opsets = {part: opset_of(each) for part, each in models.items()}
    newest = max(opsets, key=opsets.__getitem__)
    for part, opset in opsets.items():
        if opset == opsets[newest] or not opset:
            continue
        reason = newer(models[part], opsets[newest])
        if reason is not None:
            here, there = joints.graphs[part].path, joints.graphs[newest].path
            raise GraphError(
                f"{here.name} is written in opset {opset}, {there.name} in"
                f" {opsets[newest]}, and {reason}: export both in one opset"
            )
    for model in models.values():
        for domain in STANDARD:
            if domain in model.opset_imports:
                model.opset_imports[domain] = opsets[newest]
