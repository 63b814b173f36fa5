"""Inspect a stack of several files: how they are joined, and each of them."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from me2e_compress import graph
from me2e_compress.errors import RecipeError
from me2e_compress.runtime.energy.modelled import costs_of
from me2e_compress.runtime.stack.joints import Joints
from me2e_compress.runtime.stack.part_graph import told
from me2e_compress.runtime.stack.split_stack import SplitStack
from me2e_compress.workflows.checks import model_path
from me2e_compress.workflows.inspect import inspected
from me2e_compress.workflows.inspect_result import InspectResult
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.result import Result, Table, counted, megabytes, table
from me2e_compress.workflows.stack_maps import map_of_stack


@dataclasses.dataclass(frozen=True)
class FedInput:
    """One input of one file, and what feeds it.

    Attributes:
        source: an output (``backbone.feats``), ``frames``, or a state.
        form: type and shape.
    """

    file: str
    input: str
    source: str
    form: str


@dataclasses.dataclass(frozen=True, repr=False)
class StackInspectResult(Result):
    """What a stack of several files holds, by label of the file.

    Attributes:
        fed: every input of every file; in the order in which the files run.
        recurrent: outputs that are fed back, by input.
        first_values: of inputs that do not begin at zeros.
    """

    file: str
    files: Mapping[str, InspectResult]
    fed: tuple[FedInput, ...]
    outputs: tuple[str, ...]
    recurrent: Mapping[str, str]
    first_values: Mapping[str, str]

    @property
    def headline(self) -> str:
        """The TOML, its number of files and their size."""
        size = sum(each.file_bytes for each in self.files.values())
        return f"{self.file}: {counted(len(self.files), 'file')}, {megabytes(size)} MB"

    def lines(self) -> tuple[str, ...]:
        """Return the lines of each file, and the headline."""
        said = (line for each in self.files.values() for line in each.lines())
        return (*said, self.headline)

    def tables(self) -> tuple[Table, ...]:
        """Return what feeds what, and the modules file by file."""
        rows = [(each.file, each.input, each.source, each.form) for each in self.fed]
        begins = (f"{name} begins at {at}" for name, at in self.first_values.items())
        note = "; ".join((f"outputs: {', '.join(self.outputs)}", *begins))
        columns = ("file", "input", "fed by", "form")
        modules = (
            dataclasses.replace(each, title=f"{name}: {each.title}")
            for name, found in self.files.items()
            for each in found.tables()[1:]
        )
        return (table("What feeds what", columns, rows, note, words=4), *modules)

    def records(self) -> list[dict[str, object]]:
        """Return one row per file and module."""
        return [
            {"file": name, **record}
            for name, each in self.files.items()
            for record in each.records()
        ]

    def to_json(self) -> object:
        """Return everything."""
        return dataclasses.asdict(self)


def inspect_stack(
    stack: str | Path,
    module_map: str | Path | None = None,
    dims: Mapping[str, int] | None = None,
    process: str | None = None,
    trace: str | Path | None = None,
    frames: str | Path | None = None,
    listener: Listener = SILENT,
    adapter: str | Path | None = None,
) -> StackInspectResult:
    """Read a stack's TOML, and weigh the modules of each of its files.

    The arguments are those of :func:`inspect`, but a trace, frames or an adapter are
    refused: nodes are timed in one graph, and the TOML says state and plan. The map is
    one for all files.

    Raises:
        GraphError: A file is missing, or files do not fit each other.
        RecipeError: A trace, frames or an adapter is given.
        ModuleMapError: The map does not exist, or a pattern matches nothing in any
            file.
    """
    if adapter is not None:
        raise RecipeError(f"--adapter is for one file: {stack} says state and plan")
    if trace is not None or frames is not None:
        raise RecipeError(
            "--trace and --frames time the nodes of one graph: inspect one of the files"
        )
    # check names before files are read
    if process is not None:
        costs_of(process)
    # one map for all files: a pattern may match in any of them
    whole = SplitStack.load(model_path(stack))
    modules = map_of_stack(whole, module_map)
    files = {
        label: _here(
            inspected(each.path, graph.load(each.path), modules, dims, process)
        )
        for label, each in whole.files.items()
    }
    return StackInspectResult(
        whole.path.name,
        files,
        tuple(dict.fromkeys(_fed(whole, (whole.at_first, whole.at_next)))),
        tuple(whole.outputs),
        dict(whole.recurrent),
        {
            name: each.first
            for name, each in whole.content.state.items()
            if each.first != "zeros"
        },
    )


def _here(found: InspectResult) -> InspectResult:
    """Leave out the modules that other files hold."""
    held = tuple(each for each in found.modules if each.nodes)
    return dataclasses.replace(found, modules=held)


def _fed(whole: SplitStack, joints: Sequence[Joints]) -> Iterator[FedInput]:
    for each in joints:
        for part in each.order:
            file = each.graphs[part]
            for name, source in each.sources[part].items():
                if source.part:
                    given = f"{source.part}.{source.name}"
                elif source.name in whole.recurrent:
                    given = f"state: {whole.recurrent[source.name]}"
                else:
                    given = "frames"
                yield FedInput(file.label, name, given, told(file.inputs[name]))
