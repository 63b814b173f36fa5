"""Which output of a stack's files feeds which input, at first and at other frames."""

import dataclasses
import graphlib
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from me2e_compress.errors import GraphError
from me2e_compress.runtime.stack.part_graph import PartGraph, misfit, told


class FeedSource(NamedTuple):
    """What feeds an input.

    Attributes:
        part: that gives it; empty where it comes from outside: a frame, or the state.
        name: of the output, or of the input of the stack.
    """

    part: str
    name: str


Sources = Mapping[str, Mapping[str, FeedSource]]
"""By part and input, what feeds it."""


@dataclasses.dataclass(frozen=True)
class Joints:
    """How the files are joined at one kind of frame.

    Attributes:
        order: the parts that run, each behind those that feed it.
        graphs: by part, the file that runs.
        sources: by part and input, what feeds it.
    """

    order: tuple[str, ...]
    graphs: Mapping[str, PartGraph]
    sources: Sources

    @classmethod
    def of(cls, graphs: Mapping[str, PartGraph], sources: Sources) -> "Joints":
        """Check that everything fits, and find the order.

        Raises:
            GraphError: an output is missing or of another type or shape than the input
                it feeds, or the parts wait for one another.
        """
        for part, fed in sources.items():
            for name, source in fed.items():
                if source.part:
                    _check(graphs, graphs[part], name, source)
        waits = {
            part: [each.part for each in sources[part].values() if each.part]
            for part in graphs
        }
        try:
            order = tuple(graphlib.TopologicalSorter(waits).static_order())
        except graphlib.CycleError as error:
            cycle = " -> ".join(reversed(error.args[1]))
            raise GraphError(
                f"the parts wait for one another: {cycle}; what comes back at the next"
                " frame belongs into [state]"
            ) from error
        return cls(order, graphs, sources)

    def outside(self) -> Iterator[tuple[PartGraph, str, str]]:
        """Yield file, input and the input of the stack that it is."""
        for part, fed in self.sources.items():
            for name, source in fed.items():
                if not source.part:
                    yield self.graphs[part], name, source.name


def _check(
    graphs: Mapping[str, PartGraph], taker: PartGraph, name: str, source: FeedSource
) -> None:
    giver = graphs.get(source.part)
    if giver is None:
        raise GraphError(
            f"{taker.label}.{name} is fed by {source.part}.{source.name} at every"
            f" frame, and {source.part} runs at first frames alone"
        )
    given = giver.outputs.get(source.name)
    if given is None:
        raise GraphError(
            f"{taker.label}.{name} is fed by {source.part}.{source.name}, and"
            f" {giver.path} has no such output; it has {', '.join(giver.outputs)}"
        )
    if misfit(given, taker.inputs[name]):
        raise GraphError(
            f"{taker.label}.{name} takes {told(taker.inputs[name])}, and"
            f" {giver.label}.{source.name}, which feeds it, is {told(given)}"
        )


@dataclasses.dataclass(frozen=True)
class Names:
    """How the inputs and outputs of parts are called in the stack.

    Attributes:
        files: all of them.
    """

    files: Sequence[PartGraph]

    def parts(self) -> tuple[str, ...]:
        """Return the parts, in the order of the file."""
        return tuple(dict.fromkeys(each.part for each in self.files))

    def givers(self, output: str) -> tuple[str, ...]:
        """Return the parts that have an output of that name."""
        return tuple(
            dict.fromkeys(each.part for each in self.files if output in each.outputs)
        )

    def outputs_of(self, part: str) -> tuple[str, ...]:
        """Return what the files of a part give."""
        files = (each for each in self.files if each.part == part)
        return tuple(dict.fromkeys(name for each in files for name in each.outputs))

    def takers(self, name: str) -> tuple[str, ...]:
        """Return the parts that have an input of that name."""
        return tuple(
            dict.fromkeys(each.part for each in self.files if name in each.inputs)
        )

    def public(self, part: str, output: str) -> str:
        """Name an output of the stack: by its part where two have one of that name."""
        return output if len(self.givers(output)) == 1 else f"{part}.{output}"

    def output(self, text: str, where: str) -> FeedSource:
        """Find the output that a text names: ``PART.NAME``, or what one part gives.

        Raises:
            GraphError: none, or several.
        """
        givers = self.givers(text)
        if len(givers) > 1:
            raise two_givers(where, text, givers)
        if givers:
            return FeedSource(givers[0], text)
        part, _, name = text.partition(".")
        if part in self.givers(name):
            return FeedSource(part, name)
        there = [
            f"{each}.{output}"
            for each in self.parts()
            for output in self.outputs_of(each)
        ]
        raise GraphError(f"{where}: no part gives {text}; there is {', '.join(there)}")

    def inputs(self, text: str, where: str) -> tuple[tuple[str, str], ...]:
        """Find the parts and inputs that a text names: ``PART.NAME``, or all of a name.

        Raises:
            GraphError: none.
        """
        part, _, name = text.partition(".")
        if takers := self.takers(text):
            return tuple((each, text) for each in takers)
        if part in self.takers(name):
            return ((part, name),)
        there = (f"{file.label}.{each}" for file in self.files for each in file.inputs)
        raise GraphError(f"{where}: no part takes {text}; there is {', '.join(there)}")


def two_givers(where: str, name: str, givers: Sequence[str]) -> GraphError:
    """Say that several parts could feed an input."""
    ways = " or ".join(f"{each}.{name}" for each in givers)
    return GraphError(
        f"{where}: {' and '.join(givers)} both give {name}: say {ways}, by [edges]"
    )
