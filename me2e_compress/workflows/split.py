"""Split one graph into the files of the stack that it was joined from."""

import dataclasses
from pathlib import Path

from me2e_compress import graph
from me2e_compress.errors import GraphError
from me2e_compress.graph.stack.join import JoinedStack
from me2e_compress.graph.stack.split import split_stack
from me2e_compress.registry import drafts
from me2e_compress.workflows.checks import check_folder, model_path
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.result import Result, counted


@dataclasses.dataclass(frozen=True, repr=False)
class SplitResult(Result):
    """The files that were written, by part.

    Attributes:
        missing: parts that give nothing any more: no file is written for them.
    """

    output: Path
    files: dict[str, Path]
    missing: tuple[str, ...]

    @property
    def headline(self) -> str:
        """The folder and its files."""
        names = ", ".join(path.name for path in self.files.values())
        return f"{self.output}: {counted(len(self.files), 'file')}: {names}"

    def alerts(self) -> tuple[str, ...]:
        """Return the parts that are gone."""
        return tuple(f"{each}: no output is left of it" for each in self.missing)


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
    files = {part: output / joined.parts[part].file for part in parts}
    named = [
        each for path in files.values() for each in (path, *graph.data_names(path))
    ]
    inputs = (source, toml, *joined.paths)
    check_folder(output, inputs)
    with drafts.written(output, GraphError):
        for path in files.values():
            path.parent.mkdir(parents=True, exist_ok=True)
    with writing(named, inputs, force=force), drafts.all_or_none():
        for part, path in files.items():
            graph.save(parts[part], path)
    missing = tuple(each for each in joined.parts if each not in files)
    return SplitResult(output, files, missing)
