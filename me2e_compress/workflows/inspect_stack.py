"""What a stack of several files holds: how they are joined, and each of them."""

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
        file: label of the file.
        input: its name there.
        source: an output (``backbone.feats``); ``frames``; or the state:
            ``state: next_bev``.
        form: type and shape.
    """

    file: str
    input: str
    source: str
    form: str


@dataclasses.dataclass(frozen=True, repr=False)
class StackInspectResult(Result):
    """What a stack of several files holds.

    Attributes:
        file: name of the TOML.
        files: by label, what each file holds.
        fed: every input of every file, in the order in which the files run.
        outputs: of the stack.
        recurrent: inputs that are fed back from frame to frame, with the output.
        first_values: of those that do not begin at zeros, in words.
    """

    file: str
    files: Mapping[str, InspectResult]
    fed: tuple[FedInput, ...]
    outputs: tuple[str, ...]
    recurrent: Mapping[str, str]
    first_values: Mapping[str, str]

    @property
    def headline(self) -> str:
        """TOML, files, size."""
        size = sum(each.file_bytes for each in self.files.values())
        return f"{self.file}: {counted(len(self.files), 'file')}, {megabytes(size)} MB"

    def lines(self) -> tuple[str, ...]:
        """Return what each file says, and the headline."""
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
        """Return a row a module and file."""
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
    """Read a stack, and weigh the modules of each of its files.

    Args:
        stack: the TOML.
        module_map: preset or TOML file, for all files; None finds the preset.
        dims: sizes that open dimensions of the inputs are given first.
        process: as in :func:`inspect`.
        trace: not for a stack: nodes are timed in one graph at a time.
        frames: likewise.
        listener: is not called.
        adapter: not for a stack, whose TOML says state and plan.

    Raises:
        GraphError: a file is missing, or they do not fit each other.
        RecipeError: a trace, frames or an adapter.
        ModuleMapError: no such map, or a pattern matches nothing in any file.
    """
    if adapter is not None:
        raise RecipeError(f"--adapter is for one file: {stack} says state and plan")
    if trace is not None or frames is not None:
        raise RecipeError(
            "--trace and --frames time the nodes of one graph: inspect one of the files"
        )
    if process is not None:
        costs_of(process)
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
