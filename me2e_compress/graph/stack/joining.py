"""Join the files of a stack: edges and state."""

import dataclasses
import json
from collections.abc import Mapping, Sequence

from me2e_compress.errors import GraphError
from me2e_compress.graph.recurrence import RECURRENT, SessionPort, recurrence
from me2e_compress.graph.stack.joints import FeedSource, Joints, Names, ambiguous
from me2e_compress.graph.stack.part_graph import PartGraph, form, misfit
from me2e_compress.graph.stack.stack_file import StackFile
from me2e_compress.registry import documents


@dataclasses.dataclass(frozen=True, eq=False)
class Joined:
    """The result of joining a stack's files; see ``JoinedStack``.

    ``answers`` has the part and the output behind the name of each output.
    """

    inputs: Mapping[str, SessionPort]
    outputs: Mapping[str, SessionPort]
    answers: Mapping[str, tuple[str, str]]
    names: Names
    recurrent: Mapping[str, str]
    joints: Joints
    metadata: Mapping[str, str]


def join(content: StackFile, files: Sequence[PartGraph]) -> Joined:
    """Join the files of a stack."""
    # Connect the parts.
    joiner = _Joiner(content, files)
    joints = joiner.joints()
    inputs = _inputs(joints)
    # Name the outputs of the stack.
    names = joiner.names = dataclasses.replace(joiner.names, taken=inputs)
    answers = {
        names.public(each.part, output): (each.part, output)
        for each in files
        for output in each.outputs
    }
    outputs = {
        name: joints.graphs[part].outputs[output]
        for name, (part, output) in answers.items()
    }
    # Pair the state, and check that no part is left alone.
    recurrent = joiner.recurrent(inputs, outputs)
    _check_joined(joints, recurrent, answers)
    metadata = _merged(files) | content.said()
    return Joined(inputs, outputs, answers, names, recurrent, joints, metadata)


class _Joiner:
    """The rules that find the source of each input."""

    def __init__(self, content: StackFile, files: Sequence[PartGraph]) -> None:
        self.names = Names(files)
        self.files = {each.part: each for each in files}
        # A name without a part may stand for several inputs.
        self.edges = {
            taker: self.names.output(output, f"[edges] {text}")
            for text, output in content.edges.items()
            for taker in self.names.inputs(text, f"[edges] {text}")
        }
        self.state = {
            taker: output
            for text, output in content.state.items()
            for taker in self.names.inputs(text, f"[state] {text}")
        }
        # One input cannot have two sources.
        if both := [each for each in self.state if each in self.edges]:
            part, name = both[0]
            raise GraphError(f"{part}.{name} is fed by [edges] and by [state]")

    def joints(self) -> Joints:
        """Find the source of every input."""
        sources = {
            part: {name: self._source(each, name) for name in each.inputs}
            for part, each in self.files.items()
        }
        return Joints.of(self.files, sources)

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
        for (_, name), output in self.state.items():
            given = self.names.output(output, f"[state] {name}")
            pairs[name] = answer = self.names.public(*given)
            _check_answer(name, answer, inputs, outputs)
        # The naming rules complete the pairs.
        known = {name: to for name, to in pairs.items() if name in inputs}
        metadata = {RECURRENT: json.dumps(known)} if known else {}
        return recurrence(metadata, inputs, outputs)

    def _source(self, taker: PartGraph, name: str) -> FeedSource:
        # Edges come first, then state, then equal names.
        key = taker.part, name
        if key in self.edges:
            return self.edges[key]
        if key in self.state or taker.recurrent().get(name) is not None:
            return FeedSource("", name)
        # An output of the same name feeds the input.
        giving = [part for part in self.names.parts_giving(name) if part != taker.part]
        if len(giving) > 1:
            raise ambiguous(f"{taker.part}.{name}", name, giving)
        return FeedSource(giving[0] if giving else "", name)


def _inputs(joints: Joints) -> dict[str, SessionPort]:
    """Collect the external inputs; parts that share a name share the input."""
    found = dict[str, tuple[PartGraph, SessionPort]]()
    for taker, name, public in joints.outside():
        # All parts that take it must agree on type and shape.
        port = taker.inputs[name]
        other, known = found.setdefault(public, (taker, port))
        if misfit(known, port):
            raise GraphError(
                f"{other.part} takes {public} as {form(known)}, {taker.part} as"
                f" {form(port)}; one that another part gives belongs into [edges]"
            )
    return {name: port for name, (_, port) in found.items()}


def _check_answer(
    name: str,
    answer: str,
    inputs: Mapping[str, SessionPort],
    outputs: Mapping[str, SessionPort],
) -> None:
    if misfit(outputs[answer], inputs[name]):
        raise GraphError(
            f"[state] {name} takes {form(inputs[name])}, and {answer}, which is fed"
            f" back to it, is {form(outputs[answer])}"
        )


def _check_joined(
    joints: Joints,
    recurrent: Mapping[str, str],
    answers: Mapping[str, tuple[str, str]],
) -> None:
    """Raise an error if a part is not connected to the first: an edge is missing."""
    # Parts are connected by edges, or by state.
    pairs = {
        (part, source.part)
        for part, fed in joints.sources.items()
        for source in fed.values()
        if source.part
    }
    for taker, _, public in joints.outside():
        if public in recurrent:
            pairs.add((taker.part, answers[recurrent[public]][0]))
    # Grow the set of parts connected to the first one.
    parts = list(joints.graphs)
    reached = {parts[0]}
    for _ in parts:
        reached |= {b for a, b in pairs if a in reached}
        reached |= {a for a, b in pairs if b in reached}
    if alone := [each for each in parts if each not in reached]:
        there, here = joints.graphs[alone[0]], joints.graphs[parts[0]]
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
