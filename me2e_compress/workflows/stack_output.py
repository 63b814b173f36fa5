"""What is read and written of a stack of several files, beside its joined graph."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from me2e_compress import drafts, graph
from me2e_compress.errors import GraphError
from me2e_compress.workflows.checks import Given, check_folder
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.compress_result import written_files


@contextmanager
def writing_model(
    source: Path, output: Path, inputs: Iterable[Given], *, force: bool
) -> Iterator[Path]:
    """Claim what is written of a model; yield where its graph goes.

    Of a stack that is the TOML of a draft, which takes the place of a folder at the
    end.

    Raises:
        GraphError: The output would harm an input, or is no folder for a stack.
    """
    if not graph.is_stack(source):
        with writing(written_files(output), inputs, force=force):
            yield output
        return
    if output.suffix in (".onnx", ".toml"):
        raise GraphError(f"{output}: a stack is written as a folder: name one")
    check_folder(output, (*graph.paths_of(source), *inputs))
    with writing(trees=[output], force=force):
        output.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=output.parent, prefix=f".{output.name}.") as folder:
            draft = Path(folder) / output.name
            draft.mkdir()
            try:
                yield draft / source.name
            except GraphError as error:
                raise GraphError(str(error).replace(str(draft), str(output))) from error
            drafts.put(draft, output)


def written_model(source: Path, output: Path) -> Path:
    """Return the file that opens what was written: of a stack, the TOML."""
    return output / source.name if graph.is_stack(source) else output


def beside_ranges(ranges: Path, label: str) -> Path:
    """Return where the ranges of a file for first frames stand."""
    return ranges.with_name(f"{ranges.stem}.{label}.json")
