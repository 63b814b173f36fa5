"""From file to file: a model that ships, a joined stack and its parts."""

import dataclasses
from pathlib import Path

from me2e_compress import graph
from me2e_compress.base import atomic
from me2e_compress.base.display import format_mb, plural, table
from me2e_compress.base.errors import GraphError
from me2e_compress.commands.checks import check_folder, model_path, writing
from me2e_compress.commands.result import Result, View
from me2e_compress.graph import file_bytes
from me2e_compress.graph.files import data_names
from me2e_compress.graph.stack.join import JoinedStack
from me2e_compress.graph.stack.split import split_stack
from me2e_compress.shipped import drivers as shipped


@dataclasses.dataclass(frozen=True, repr=False)
class ExportResult(Result):
    """A model that was written."""

    stack: str
    output: Path

    @property
    def headline(self) -> str:
        """The file, its model and size."""
        return f"{self.output}: {self.stack}, {format_mb(file_bytes(self.output))} MB"


def export_stack(
    stack: str, output: str | Path, *, force: bool = False
) -> ExportResult:
    """Write a copy of a trained model that ships: ``highway``.

    The folder of the output is made if needed. ``force`` replaces a file that we did
    not write, too.

    Raises:
        GraphError: No such model ships, or the output is not usable.
    """
    output = Path(output)
    files = [output] if output.parent.is_dir() else []  # else it is made
    with writing(files, force=force):
        shipped.copy(stack, output)
    return ExportResult(stack, output)


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

    def view(self) -> View:
        """Return the file, its size and parts, and what feeds every input of a part."""
        size, parts = format_mb(self.file_bytes), plural(len(self.parts), "part")
        rows = [dataclasses.astuple(feed) for feed in self.fed]
        columns = ("part", "input", "fed by", "form")
        return View(
            f"{self.output}: {size} MB, {parts}: {', '.join(self.parts)}",
            [table("What feeds what", columns, rows, words=4)],
        )


def join(stack: str | Path, output: str | Path, *, force: bool = False) -> JoinResult:
    """Join the files that a stack's TOML names, and write them as one graph.

    Frames are recorded for the inputs of that graph. ``force`` replaces an output that
    we did not write, too.

    Raises:
        GraphError: The files do not exist or fit, or the output would harm an input.
    """
    source, output = Path(stack), Path(output)
    joined = JoinedStack.load(source)
    # External weights lie beside the graph
    outputs = (output, *data_names(output))
    with writing(outputs, (source, *joined.paths), force=force):
        graph.save(joined.model, output)
    inputs = tuple(FedInput(*feed) for feed in joined.feeds())
    return JoinResult(output, graph.file_bytes(output), joined.order, inputs)


@dataclasses.dataclass(frozen=True, repr=False)
class SplitResult(Result):
    """The files that were written, by part.

    Attributes:
        missing: parts that give nothing any more: no file is written for them.
    """

    output: Path
    files: dict[str, Path]
    missing: tuple[str, ...]

    def view(self) -> View:
        """Return the folder, its files and the parts without outputs."""
        names = ", ".join(path.name for path in self.files.values())
        return View(
            f"{self.output}: {plural(len(self.files), 'file')}: {names}",
            alerts=[f"{part}: no output is left of it" for part in self.missing],
        )


def split(
    model: str | Path, stack: str | Path, output: str | Path, *, force: bool = False
) -> SplitResult:
    """Cut a graph that passes made of a joined one into files, in a folder.

    Each file has the name, the inputs and the outputs of the one in the stack: whoever
    runs the files one by one goes on. A constant that two parts read stands in both.
    ``force`` replaces files that we did not write, too.

    Raises:
        GraphError: A part would need what another one does not give, the graph is of
            another stack, or an output would harm an input.
    """
    source, toml, output = model_path(model), Path(stack), Path(output)
    joined, whole = JoinedStack.load(toml), graph.load(source)
    try:
        parts = split_stack(joined, whole)
    except GraphError as error:
        raise GraphError(f"{source}: {error}") from error
    if not parts:
        raise GraphError(f"{source}: gives none of the outputs of {toml}")
    # Every part is a file of the folder, perhaps with weights beside it
    files = {part: output / joined.parts[part].file for part in parts}
    named = [name for path in files.values() for name in (path, *data_names(path))]
    inputs = (source, toml, *joined.paths)
    check_folder(output, inputs)
    with atomic.writing_errors(output, GraphError):
        for path in files.values():
            path.parent.mkdir(parents=True, exist_ok=True)
    with writing(named, inputs, force=force), atomic.all_or_none():
        for part, path in files.items():
            graph.save(parts[part], path)
    missing = tuple(part for part in joined.parts if part not in files)
    return SplitResult(output, files, missing)
