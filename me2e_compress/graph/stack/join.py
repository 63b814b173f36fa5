"""Join the ONNX files of a stack into one graph."""

import graphlib
import json
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple, Self

import onnx_ir as ir

from me2e_compress.base import documents
from me2e_compress.base.errors import GraphError
from me2e_compress.graph.nodes import STANDARD, graphs_of, nodes_of, opset_of
from me2e_compress.graph.recurrence import RECURRENT, SessionPort, recurrence
from me2e_compress.graph.rewrite.raise_opset import raise_opset
from me2e_compress.graph.stack.stack_file import Part, StackFile


class End(NamedTuple):
    """An input or output of a part; without a part, an input of the whole stack."""

    part: str
    name: str

    def __str__(self) -> str:
        """Return the name that a TOML gives it."""
        return f"{self.part}.{self.name}"


Parts = Mapping[str, Part]


class JoinedStack:
    """A stack of several files, joined into one graph.

    Attributes:
        parts: the files by part, in the order of the TOML.
        order: the parts in topological order.
        sources: the source of every input of a part: an output of another part, or an
            input of the stack.
        outputs: the outputs of all parts.
        inputs: the inputs of the stack; parts that share a name share the input.
        names: the name in the graph of every output: ``NAME``, or ``PART.NAME`` if two
            parts, or an input of the stack, have that name.
        recurrent: ``{input: output}`` of states, which are fed back at the next frame.
        model: the graph.
    """

    def __init__(self, parts: Parts, content: StackFile) -> None:
        self.parts = parts
        self.outputs = [
            End(part, name) for part, file in parts.items() for name in file.outputs
        ]
        # The sources of inputs, and the order of the parts
        edges = {
            taker: self._output(output, f"[edges] {text}")
            for text, output in content.edges.items()
            for taker in self._ends(text, f"[edges] {text}")
        }
        state = {
            taker: output
            for text, output in content.state.items()
            for taker in self._ends(text, f"[state] {text}")
        }
        if both := [taker for taker in state if taker in edges]:
            raise GraphError(f"{both[0]} is fed by [edges] and by [state]")
        self.sources = {
            End(part, name): self._source(End(part, name), edges, state)
            for part, file in parts.items()
            for name in file.inputs
        }
        self.order = self._order()
        self.inputs = self._inputs()
        # Names of the outputs, and the states
        counts = Counter(end.name for end in self.outputs)
        self.names = {
            end: end.name
            if counts[end.name] == 1 and end.name not in self.inputs
            else str(end)
            for end in self.outputs
        }
        self.recurrent = self._recurrent(state)
        self._check_connected()
        # One graph, with the states in its metadata
        self.model = _merged(self)
        pairs = {name: self.recurrent.get(name) for name in self.inputs}
        self.model.metadata_props.update(_metadata(parts) | content.metadata)
        self.model.metadata_props[RECURRENT] = json.dumps(pairs)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a TOML file and the files it names, and join them, or a GraphError."""
        content = StackFile.load(path)
        try:
            parts = {entry.name: Part.load(entry, path) for entry in content.part}
            joined = cls(parts, content)
        except GraphError as error:
            raise GraphError(f"{path}: {error}") from error
        joined.model.graph.name = path.stem
        return joined

    @property
    def paths(self) -> tuple[Path, ...]:
        """The files that were read."""
        return tuple(file.path for file in self.parts.values())

    def feeds(self) -> Iterator[tuple[str, str, str, str]]:
        """Yield part, input, source and type of every input, in topological order.

        A source is an output (``backbone.feats``), ``frames`` or ``state: OUTPUT``.
        """
        for part in self.order:
            for name, port in self.parts[part].inputs.items():
                source = self.sources[End(part, name)]
                origin = f"state: {self.recurrent.get(source.name)}"
                if source.part:
                    origin = str(source)
                elif source.name not in self.recurrent:
                    origin = "frames"
                yield part, name, origin, _form(port)

    def _port(self, end: End, *, output: bool = False) -> SessionPort:
        part = self.parts[end.part]
        return (part.outputs if output else part.inputs)[end.name]

    def _ends(self, text: str, where: str, *, outputs: bool = False) -> list[End]:
        """Return the inputs or outputs of a text: all of a name, or ``PART.NAME``."""
        parts = self.parts.items()
        inputs = [End(part, name) for part, file in parts for name in file.inputs]
        ends = self.outputs if outputs else inputs
        matches = [end for end in ends if end.name == text]
        matches = matches or [end for end in ends if str(end) == text]
        if not matches:
            does, there = "gives" if outputs else "takes", ", ".join(map(str, ends))
            raise GraphError(f"{where}: no part {does} {text}; there is {there}")
        return matches

    def _output(self, text: str, where: str) -> End:
        """Return the only output of a text, or raise a GraphError."""
        end, *others = self._ends(text, where, outputs=True)
        if others:
            raise _ambiguous(where, text, [end, *others])
        return end

    def _source(
        self, taker: End, edges: Mapping[End, End], state: Mapping[End, str]
    ) -> End:
        """Return the source of an input: an edge, a state or an output of that name."""
        if taker in edges:
            return edges[taker]
        # A state is an input of the stack; else the one output of that name is meant
        declared = self.parts[taker.part].recurrent().get(taker.name)
        givers = [end for end in self.outputs if end.name == taker.name]
        givers = [end for end in givers if end.part != taker.part]
        if taker in state or declared is not None or not givers:
            return End("", taker.name)
        if len(givers) > 1:
            raise _ambiguous(str(taker), taker.name, givers)
        return givers[0]

    def _order(self) -> tuple[str, ...]:
        """Sort the parts topologically; refuse cycles and types that do not fit."""
        waits: dict[str, list[str]] = {part: [] for part in self.parts}
        for taker, source in self.sources.items():
            if not source.part:
                continue
            # A part waits for those that feed it, by types that fit
            waits[taker.part].append(source.part)
            port_out, port_in = self._port(source, output=True), self._port(taker)
            if _misfit(port_out, port_in):
                raise GraphError(
                    f"{taker} takes {_form(port_in)}, and {source}, which feeds it, is"
                    f" {_form(port_out)}"
                )
        try:
            return tuple(graphlib.TopologicalSorter(waits).static_order())
        except graphlib.CycleError as error:
            cycle = " -> ".join(reversed(error.args[1]))
            raise GraphError(
                f"the parts wait for one another: {cycle}; what comes back at the next"
                " frame belongs into [state]"
            ) from error

    def _inputs(self) -> dict[str, SessionPort]:
        """Return the inputs of the stack; parts that share one must agree on it."""
        first = dict[str, End]()
        for taker, source in self.sources.items():
            if source.part:
                continue
            other = first.setdefault(source.name, taker)
            known, port = self._port(other), self._port(taker)
            if _misfit(known, port):
                raise GraphError(
                    f"{other.part} takes {source.name} as {_form(known)}, {taker.part}"
                    f" as {_form(port)}; one that another part gives belongs into"
                    " [edges]"
                )
        return {name: self._port(end) for name, end in first.items()}

    def _recurrent(self, state: Mapping[End, str]) -> dict[str, str]:
        """Pair inputs with the outputs that are fed back to them at the next frame."""
        names = self.names
        outputs = {names[end]: self._port(end, output=True) for end in self.outputs}
        # Metadata of the files come first; [state] overrides them
        pairs = dict[str, str | None]()
        for part, file in self.parts.items():
            for name, output in file.recurrent().items():
                if output is None:
                    pairs.setdefault(name, None)
                    continue
                end = End(part, output)
                other = output if output in outputs else str(end)
                pairs[name] = names.get(end, other)
        for (_, name), output in state.items():
            answer = names[self._output(output, f"[state] {name}")]
            port_out, port_in = outputs[answer], self.inputs[name]
            if _misfit(port_out, port_in):
                raise GraphError(
                    f"[state] {name} takes {_form(port_in)}, and {answer}, which is fed"
                    f" back to it, is {_form(port_out)}"
                )
            pairs[name] = answer
        # The naming rules complete the pairs
        known = {name: to for name, to in pairs.items() if name in self.inputs}
        metadata = {RECURRENT: json.dumps(known)} if known else {}
        return recurrence(metadata, self.inputs, outputs)

    def _check_connected(self) -> None:
        """Refuse a part that neither edges nor state connect to the first."""
        part_of = {name: end.part for end, name in self.names.items()}
        # Pairs of parts of which one feeds the other, within a frame or at the next
        pairs = set[tuple[str, str]]()
        for taker, source in self.sources.items():
            if source.part:
                pairs.add((taker.part, source.part))
            elif source.name in self.recurrent:
                pairs.add((taker.part, part_of[self.recurrent[source.name]]))
        # What is reached from the first part in either direction
        first, *others = self.parts
        reached = {first}
        for _ in self.parts:
            reached |= {b for a, b in pairs if a in reached}
            reached |= {a for a, b in pairs if b in reached}
        if alone := [part for part in others if part not in reached]:
            outputs, inputs = self.parts[first].outputs, self.parts[alone[0]].inputs
            raise GraphError(
                f"nothing joins {alone[0]} to {first}: [edges] must say which of"
                f" {', '.join(outputs)} (of {first}) feeds which of"
                f" {', '.join(inputs)} (of {alone[0]})"
            )


def _ambiguous(where: str, name: str, givers: list[End]) -> GraphError:
    parts, ways = " and ".join(e.part for e in givers), " or ".join(map(str, givers))
    return GraphError(f"{where}: {parts} both give {name}: say {ways}, by [edges]")


def _misfit(port_out: SessionPort, port_in: SessionPort) -> bool:
    """Return whether an output can never feed an input; an empty shape is unknown."""
    if port_out.type != port_in.type:
        return True
    if not port_out.shape or not port_in.shape:
        return False
    return len(port_out.shape) != len(port_in.shape) or any(
        isinstance(one, int) and isinstance(other, int) and one != other
        for one, other in zip(port_out.shape, port_in.shape, strict=True)
    )


def _form(port: SessionPort) -> str:
    """Describe type and shape: ``float [1, 6, 2]``."""
    return f"{port.type.removeprefix('tensor(').removesuffix(')')} {list(port.shape)}"


def _metadata(parts: Parts) -> dict[str, str]:
    """Merge metadata: JSON objects that agree are joined, else a later file wins."""

    def table(text: str) -> dict[str, object]:
        try:
            value = documents.from_json(text)
        except documents.MalformedError:
            return {}
        return value if isinstance(value, dict) else {}

    # Each file may speak of its own outputs under one key, as in `me2e.sets`
    merged = dict[str, str]()
    for file in parts.values():
        for key, text in file.model.metadata_props.items():
            before, now = table(merged.get(key, "")), table(text)
            agree = before and now and before | now == now | before
            merged[key] = json.dumps(before | now) if agree else text
    return merged


def _merged(stack: JoinedStack) -> ir.Model:
    """Return one graph of all parts; weights are shared with the files' graphs."""
    parts, names, inputs = stack.parts, stack.names, stack.inputs
    models = {part: file.model.clone() for part, file in parts.items()}
    _write_one_opset(parts, models)
    functions = _functions(models)
    _rename_apart(models, {*names.values(), *inputs})
    # Move nodes and weights; inputs become what feeds them
    nodes, weights = list[ir.Node](), list[ir.Value]()
    inputs_by_name, outputs_by_end = dict[str, ir.Value](), dict[End, ir.Value]()
    for part in stack.order:
        graph, file = models[part].graph, parts[part]
        takers, outputs = list(graph.inputs), _outputs(graph, file)
        weights += graph.initializers.values()
        body = list(graph)
        graph.inputs.clear()
        graph.outputs.clear()
        graph.initializers.clear()
        graph.remove(body)
        nodes += body
        for value, name in zip(takers, file.inputs, strict=True):
            source = stack.sources[End(part, name)]
            if source.part:
                known = outputs_by_end[source]
            else:
                value.name = source.name
                known = inputs_by_name.setdefault(source.name, value)
            if known is not value:
                ir.convenience.replace_all_uses_with(value, known)
        for value, name in zip(outputs, file.outputs, strict=True):
            end = End(part, name)
            value.name, outputs_by_end[end] = names[end], value
    imports = {
        domain: version
        for model in models.values()
        for domain, version in model.opset_imports.items()
    }
    joined = ir.Graph(
        [inputs_by_name[name] for name in inputs],
        [outputs_by_end[end] for end in names],
        nodes=nodes,
        initializers=weights,
        opset_imports=imports,
    )
    joined.sort()
    newest = max(model.ir_version for model in models.values())
    return ir.Model(joined, ir_version=newest, functions=functions)


def _outputs(graph: ir.Graph, file: Part) -> list[ir.Value]:
    """List the outputs; those that no node makes get an Identity, to be renamed."""
    outputs = list[ir.Value]()
    for value in list(graph.outputs):
        if graph.outputs.count(value) > 1:
            raise GraphError(f"{file.path}: output {value.name} is listed twice")
        if value.producer() is None:
            node = ir.node("Identity", [value], name=f"{value.name}/passed_on")
            (copy,) = node.outputs
            copy.type, copy.shape = value.type, value.shape
            graph.append(node)
            value = copy
        outputs.append(value)
    return outputs


def _rename_apart(models: Mapping[str, ir.Model], public: Collection[str]) -> None:
    """Prefix names of inner values and nodes that occur in several parts."""

    # A name of two parts is prefixed by the part: `head.w`, and `/head/Mul` for `/Mul`
    def apart(
        named: Mapping[str, list[ir.Value] | list[ir.Node]], reserved: Collection[str]
    ) -> None:
        per_part = ({item.name for item in items} for items in named.values())
        counts = Counter(name for names in per_part for name in names if name)
        used = {*counts, *reserved}
        for part, items in named.items():
            known = dict[str, str]()
            for item in items:
                name = item.name
                if not name or (counts[name] == 1 and name not in reserved):
                    continue
                if name not in known:
                    free = f"/{part}{name}" if name[0] == "/" else f"{part}.{name}"
                    while free in used:
                        free += "_"
                    used.add(free)
                    known[name] = free
                item.name = known[name]

    # Every value but the graph's own inputs and outputs, then nodes
    values, nodes = dict[str, list[ir.Value]](), dict[str, list[ir.Node]]()
    for part, model in models.items():
        graphs = list(graphs_of(model.graph))
        nodes[part] = [node for body in graphs for node in body]
        inner = [
            v for body in graphs for v in (*body.inputs, *body.initializers.values())
        ]
        inner += [value for node in nodes[part] for value in node.outputs]
        ends = {*model.graph.inputs, *model.graph.outputs}
        values[part] = [value for value in inner if value not in ends]
    apart(values, public)
    apart(nodes, ())


def _functions(models: Mapping[str, ir.Model]) -> list[ir.Function]:
    """Collect the functions; of two that differ under one name, rename the second."""
    known = dict[ir.OperatorIdentifier, ir.Function]()
    for part, model in models.items():
        for key, function in list(model.functions.items()):
            other = known.setdefault(key, function)
            if other is function or _text(other) == _text(function):
                continue
            name = f"{function.name}_{part}"
            for node in nodes_of(model):
                if node.op_identifier() == key:
                    node.op_type = name
            function.name = name
            known[function.identifier()] = function
    return list(known.values())


def _text(function: ir.Function) -> bytes:
    return ir.serde.serialize_function(function).SerializeToString(deterministic=True)


def _write_one_opset(parts: Parts, models: Mapping[str, ir.Model]) -> None:
    """Convert every part to the newest opset of all, or raise a GraphError."""
    opsets = {part: opset_of(model) for part, model in models.items()}
    newest = max(opsets, key=opsets.__getitem__)
    for part, opset in opsets.items():
        if opset == opsets[newest] or not opset:
            continue
        _, reason = raise_opset(models[part], opsets[newest], "join")
        if reason:
            here, there = parts[part].path, parts[newest].path
            raise GraphError(
                f"{here.name} is written in opset {opset}, {there.name} in"
                f" {opsets[newest]}, and {reason}: export both in one opset"
            )
    for model in models.values():
        for domain in STANDARD:
            if domain in model.opset_imports:
                model.opset_imports[domain] = opsets[newest]
