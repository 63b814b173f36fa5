"""Join the files of a stack: edges, state and first values."""

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from me2e_compress.errors import GraphError
from me2e_compress.graph.nodes import Array
from me2e_compress.graph.recurrence import RECURRENT, SessionPort, recurrence
from me2e_compress.graph.stack.first_values import fitted, read_value
from me2e_compress.graph.stack.joints import FeedSource, Joints, Names, ambiguous
from me2e_compress.graph.stack.part_graph import PartGraph, form, misfit
from me2e_compress.graph.stack.stack_file import ZEROS, StackFile, StateEntry
from me2e_compress.registry import documents


@dataclasses.dataclass(frozen=True, eq=False)
class Joined:
    """The result of joining a stack's files; see ``JoinedStack``."""

    inputs: Mapping[str, SessionPort]
    outputs: Mapping[str, SessionPort]
    answers: Mapping[str, tuple[str, str]]
    names: Names
    recurrent: Mapping[str, str]
    first_values: Mapping[str, Array]
    at_first: Joints
    at_next: Joints
    metadata: Mapping[str, str]


def join(content: StackFile, files: Sequence[PartGraph], folder: Path) -> Joined:
    """Join the files of a stack; paths of first values are relative to ``folder``."""
    # Connect the parts, for first and for other frames.
    joiner = _Joiner(content, files, folder)
    at_next = joiner.joints(first=False)
    at_first = joiner.joints(first=True)
    inputs = _inputs((at_next, at_first))
    joiner.names = dataclasses.replace(joiner.names, taken=inputs)
    # Name the outputs of the stack.
    answers = dict(joiner.answers())
    outputs = {
        name: joiner.files[part].outputs[output]
        for name, (part, output) in answers.items()
    }
    # Pair the state, and check that no part is left alone.
    recurrent = joiner.recurrent(inputs, outputs)
    _check_joined(joiner.names.parts(), (at_next, at_first), recurrent, answers)
    first_values = joiner.first_values(inputs, at_first)
    # files that run at most frames win over those for first frames
    kept = [each.label for each in at_next.graphs.values()]
    ranked = sorted(files, key=lambda each: each.label in kept)
    metadata = _merged(ranked) | content.said()
    return Joined(
        *(inputs, outputs, answers, joiner.names, recurrent, first_values),
        *(at_first, at_next, metadata),
    )


class _Joiner:
    """The rules that find the source of each input."""

    def __init__(
        self, content: StackFile, files: Sequence[PartGraph], folder: Path
    ) -> None:
        self.content = content
        self.folder = folder
        self.names = Names(files)
        self.files = {each.label: each for each in files}
        # A name without a part may stand for several inputs.
        self.edges = {
            taker: self.names.output(output, f"[edges] {text}")
            for text, output in content.edges.items()
            for taker in self.names.inputs(text, f"[edges] {text}")
        }
        self.state = {
            taker: entry
            for text, entry in content.state.items()
            for taker in self.names.inputs(text, f"[state] {text}")
        }
        # One input cannot have two sources.
        if both := [each for each in self.state if each in self.edges]:
            part, name = both[0]
            raise GraphError(f"{part}.{name} is fed by [edges] and by [state]")

    def joints(self, *, first: bool) -> Joints:
        """Find the source of every input at one kind of frame."""
        graphs = dict(self._running(first=first))
        sources = {
            part: {
                name: self._source(graphs, each, name, first=first)
                for name in each.inputs
            }
            for part, each in graphs.items()
        }
        return Joints.of(graphs, sources)

    def answers(self) -> Iterator[tuple[str, tuple[str, str]]]:
        """Yield the name, part and output of what is present at every frame."""
        for part, each in self._running(first=False):
            at_first = dict(self._running(first=True))[part]
            for output in each.outputs:
                if output in at_first.outputs:
                    yield self.names.public(part, output), (part, output)

    def recurrent(
        self, inputs: Mapping[str, SessionPort], outputs: Mapping[str, SessionPort]
    ) -> dict[str, str]:
        """Pair recurrent inputs with the outputs that are fed back to them."""
        pairs = dict[str, str | None]()
        # Metadata of the files comes first; [state] overrides it.
        for each in self.files.values():
            for name, output in each.recurrent().items():
                if output is None:
                    pairs.setdefault(name, None)
                else:
                    pairs[name] = self.names.public(each.part, output)
        for (_, name), entry in self.state.items():
            if entry.answer is not None:
                given = self.names.output(entry.answer, f"[state] {name}")
                pairs[name] = answer = self.names.public(*given)
                _check_answer(name, answer, inputs, outputs)
            elif pairs.get(name) is None:
                pairs.pop(name, None)
        # The naming rules complete the pairs.
        known = {name: to for name, to in pairs.items() if name in inputs}
        metadata = {RECURRENT: json.dumps(known)} if known else {}
        found = recurrence(metadata, inputs, outputs)
        for _, name in self.state:
            if name not in found:
                raise GraphError(
                    f"[state] {name}: no output answers it by its name; say from ="
                    f" one of {', '.join(outputs)}"
                )
        return found

    def first_values(
        self, inputs: Mapping[str, SessionPort], at_first: Joints
    ) -> dict[str, Array]:
        """Read the first values that are not zeros."""
        read = {name for _, _, name in at_first.outside()}
        found = dict[str, Array]()
        for (part, name), entry in self.state.items():
            if entry.first == ZEROS or self._given_first(entry) is not None:
                continue
            # Files and initializers are read; outputs are joined instead.
            where = f"[state] {name}: first value {entry.first}"
            if name not in read:
                raise GraphError(
                    f"{where} is read by nobody: {part}'s first_frame takes none"
                )
            value = self._array(entry.first, name, where)
            found[name] = fitted(value, inputs[name], where)
        return found

    def _running(self, *, first: bool) -> Iterator[tuple[str, PartGraph]]:
        for entry in self.content.part:
            labels = [label for label, _ in entry.files()]
            if first:
                yield entry.name, self.files[labels[-1]]
            elif entry.file is not None:
                yield entry.name, self.files[labels[0]]

    def _source(
        self,
        graphs: Mapping[str, PartGraph],
        taker: PartGraph,
        name: str,
        *,
        first: bool,
    ) -> FeedSource:
        # Edges come first, then state, then equal names.
        key = taker.part, name
        if key in self.edges:
            return self.edges[key]
        if key in self.state:
            given = self._given_first(self.state[key]) if first else None
            return given or FeedSource("", name)
        if taker.recurrent().get(name) is not None:
            return FeedSource("", name)
        # An output of the same name feeds the input.
        giving = [
            part
            for part, each in graphs.items()
            if part != taker.part and name in each.outputs
        ]
        if len(giving) > 1:
            raise ambiguous(f"{taker.label}.{name}", name, giving)
        return FeedSource(giving[0] if giving else "", name)

    def _given_first(self, entry: StateEntry) -> FeedSource | None:
        """Return the output that is a first value; None where it is something else."""
        part, _, name = entry.first.partition(".")
        return FeedSource(part, name) if part in self.names.parts_giving(name) else None

    def _array(self, text: str, name: str, where: str) -> Array:
        path = self.folder / text
        if path.suffix in (".npy", ".npz"):
            return read_value(path, name, where)
        part, _, initializer = text.partition(".")
        for each in self.files.values():
            value = each.initializer(initializer) if each.part == part else None
            if value is not None:
                return value
        raise GraphError(
            f"{where} is none of {ZEROS}, a file .npy or .npz, and PART.NAME of an"
            " initializer or an output"
        )


def _inputs(joints: Sequence[Joints]) -> dict[str, SessionPort]:
    """Collect the external inputs; parts that share a name share the input."""
    found = dict[str, tuple[PartGraph, SessionPort]]()
    for each in joints:
        for taker, name, public in each.outside():
            # All parts that take it must agree on type and shape.
            port = taker.inputs[name]
            other, known = found.setdefault(public, (taker, port))
            if misfit(known, port):
                raise GraphError(
                    f"{other.label} takes {public} as {form(known)}, {taker.label} as"
                    f" {form(port)}; one that another part gives belongs into [edges]"
                )
    return {name: port for name, (_, port) in found.items()}


def _check_answer(
    name: str,
    answer: str,
    inputs: Mapping[str, SessionPort],
    outputs: Mapping[str, SessionPort],
) -> None:
    if answer not in outputs:
        raise GraphError(f"[state] {name}: {answer} does not come at every frame")
    if name in inputs and misfit(outputs[answer], inputs[name]):
        raise GraphError(
            f"[state] {name} takes {form(inputs[name])}, and {answer}, which is fed"
            f" back to it, is {form(outputs[answer])}"
        )


def _check_joined(
    parts: Sequence[str],
    joints: Sequence[Joints],
    recurrent: Mapping[str, str],
    answers: Mapping[str, tuple[str, str]],
) -> None:
    """Raise an error if a part is not connected to the first: an edge is missing."""
    # Parts are connected by edges, or by state.
    pairs = {
        (part, source.part)
        for each in joints
        for part, fed in each.sources.items()
        for source in fed.values()
        if source.part
    }
    for each in joints:
        for taker, _, public in each.outside():
            if public in recurrent:
                pairs.add((taker.part, answers[recurrent[public]][0]))
    # Grow the set of parts connected to the first one.
    reached = {parts[0]}
    for _ in parts:
        reached |= {b for a, b in pairs if a in reached}
        reached |= {a for a, b in pairs if b in reached}
    if alone := [each for each in parts if each not in reached]:
        graphs = joints[1].graphs
        there, here = graphs[alone[0]], graphs[parts[0]]
        raise GraphError(
            f"nothing joins {alone[0]} to {parts[0]}: [edges] must say which of"
            f" {', '.join(here.outputs)} (of {here.part}) feeds which of"
            f" {', '.join(there.inputs)} (of {there.part})"
        )


def _merged(files: Sequence[PartGraph]) -> dict[str, str]:
    """Merge metadata: JSON objects that agree are joined, else a later file wins."""
    found = dict[str, str]()
    for each in files:
        for key, text in each.metadata.items():
            before, now = _object(found.get(key, "")), _object(text)
            agree = all(now.get(name, value) == value for name, value in before.items())
            found[key] = json.dumps(before | now) if before and now and agree else text
    found.pop(RECURRENT, None)
    return found


def _object(text: str) -> dict[str, object]:
    """Read a JSON object; anything else gives an empty one."""
    try:
        value = documents.from_json(text)
    except documents.MalformedError:
        return {}
    return value if isinstance(value, dict) else {}
