"""Join the files of a stack into one graph."""

import dataclasses
from pathlib import Path

from me2e_compress import graph
from me2e_compress.graph.stack.join import JoinedStack
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.result import Result, Table, counted, megabytes, table


@dataclasses.dataclass(frozen=True)
class FedInput:
    """One input of one file of a stack, and what feeds it.

    Attributes:
        source: an output such as ``backbone.feats``, ``frames``, or the state and the
            output that is fed back.
        form: type and shape.
    """

    part: str
    input: str
    source: str
    form: str


@dataclasses.dataclass(frozen=True, repr=False)
class JoinResult(Result):
    """The graph that was written, and what feeds what in it, in the order of running.

    Attributes:
        file_bytes: size with the external weights.
    """

    output: Path
    file_bytes: int
    parts: tuple[str, ...]
    fed: tuple[FedInput, ...]

    @property
    def headline(self) -> str:
        """The file, its size and its parts."""
        size, parts = megabytes(self.file_bytes), counted(len(self.parts), "part")
        return f"{self.output}: {size} MB, {parts}: {', '.join(self.parts)}"

    def tables(self) -> tuple[Table, ...]:
        """Return what feeds every input of every part."""
        rows = [dataclasses.astuple(each) for each in self.fed]
        columns = ("part", "input", "fed by", "form")
        return (table("What feeds what", columns, rows, words=4),)


def join(stack: str | Path, output: str | Path, *, force: bool = False) -> JoinResult:
    """Join the files that a stack's TOML names, and write them as one graph.

    Frames are recorded for the inputs of that graph. ``force`` replaces an output that
    we did not write, too.

    Raises:
        GraphError: The files do not exist or fit, or the output would harm an input.
    """
    source, output = Path(stack), Path(output)
    joined = JoinedStack.load(source)
    outputs = (output, *graph.data_names(output))
    with writing(outputs, (source, *joined.paths), force=force):
        graph.save(joined.model, output)
    fed = tuple(FedInput(*each) for each in joined.feeds())
    return JoinResult(output, graph.file_bytes(output), joined.order, fed)
