"""Connections between the files of a stack."""

import dataclasses
import graphlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

from me2e_compress.errors import GraphError
from me2e_compress.graph.stack.part_graph import PartGraph, form, misfit


class FeedSource(NamedTuple):
    """An output that feeds an input; the part is empty for a frame or the state."""

    part: str
    name: str


Sources = Mapping[str, Mapping[str, FeedSource]]
"""The source of each input, by part and input."""


@dataclasses.dataclass(frozen=True)
class Joints:
    """The connections of the files, parts in topological order."""

    order: tuple[str, ...]
    graphs: Mapping[str, PartGraph]
    sources: Sources

    @classmethod
    def of(cls, graphs: Mapping[str, PartGraph], sources: Sources) -> "Joints":
        """Check that all connections fit, and sort the parts; refuse cycles."""
        for part, fed in sources.items():
            for name, source in fed.items():
                if source.part:
                    _check(graphs, graphs[part], name, source)
        # Sort the parts by their dependencies.
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
        """Yield the file, its input and the stack's input, for external inputs."""
        for part, fed in self.sources.items():
            for name, source in fed.items():
                if not source.part:
                    yield self.graphs[part], name, source.name


def _check(
    graphs: Mapping[str, PartGraph], taker: PartGraph, name: str, source: FeedSource
) -> None:
    giver = graphs[source.part]
    given = giver.outputs[source.name]
    if misfit(given, taker.inputs[name]):
        raise GraphError(
            f"{taker.part}.{name} takes {form(taker.inputs[name])}, and"
            f" {giver.part}.{source.name}, which feeds it, is {form(given)}"
        )


@dataclasses.dataclass(frozen=True)
class Names:
    """The names of the parts' inputs and outputs in the stack.

    ``taken`` has the stack's own inputs, whose names no output may have.
    """

    files: Sequence[PartGraph]
    taken: Collection[str] = ()

    def parts_giving(self, output: str) -> tuple[str, ...]:
        """Return the parts that have an output of that name."""
        return tuple(each.part for each in self.files if output in each.outputs)

    def parts_taking(self, name: str) -> tuple[str, ...]:
        """Return the parts that have an input of that name."""
        return tuple(each.part for each in self.files if name in each.inputs)

    def public(self, part: str, output: str) -> str:
        """Return the stack's name of an output, with its part if it is ambiguous."""
        alone = len(self.parts_giving(output)) == 1 and output not in self.taken
        return output if alone else f"{part}.{output}"

    def output(self, text: str, where: str) -> FeedSource:
        """Find the output of a text: ``PART.NAME``, or a name that one part gives."""
        giving = self.parts_giving(text)
        if len(giving) > 1:
            raise ambiguous(where, text, giving)
        if giving:
            return FeedSource(giving[0], text)
        part, _, name = text.partition(".")
        if part in self.parts_giving(name):
            return FeedSource(part, name)
        there = (f"{file.part}.{each}" for file in self.files for each in file.outputs)
        raise GraphError(f"{where}: no part gives {text}; there is {', '.join(there)}")

    def inputs(self, text: str, where: str) -> tuple[tuple[str, str], ...]:
        """Find the (part, input) pairs of a text: ``PART.NAME``, or any of a name."""
        part, _, name = text.partition(".")
        if takers := self.parts_taking(text):
            return tuple((each, text) for each in takers)
        if part in self.parts_taking(name):
            return ((part, name),)
        there = (f"{file.part}.{each}" for file in self.files for each in file.inputs)
        raise GraphError(f"{where}: no part takes {text}; there is {', '.join(there)}")


def ambiguous(where: str, name: str, giving: Sequence[str]) -> GraphError:
    """Build the error for an input that several parts could feed."""
    ways = " or ".join(f"{each}.{name}" for each in giving)
    return GraphError(
        f"{where}: {' and '.join(giving)} both give {name}: say {ways}, by [edges]"
    )
