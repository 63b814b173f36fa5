"""Calibrate every file of a stack while the whole stack runs."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from me2e_compress import drafts, recipe
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.calibration.sample import draw
from me2e_compress.calibration.stack_calibrator import StackCalibrator
from me2e_compress.errors import FramesError, GraphError, PreconditionError
from me2e_compress.passes.fix_shapes import with_sizes
from me2e_compress.runtime.stack.split_stack import SplitStack
from me2e_compress.workflows.calibrate import CalibrateOptions
from me2e_compress.workflows.calibrate_result import CalibrateResult
from me2e_compress.workflows.checks import check_folder, model_path, read_graph
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.first_opening import try_file
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.prepare_int8 import PreparedGraph
from me2e_compress.workflows.result import Result, Table
from me2e_compress.workflows.stack_maps import map_of_stack

_OF_ONE_FILE = (
    "shard",
    "merge",
    "imported",
    "tensorrt_cache",
    "onnxruntime_table",
    "adapter",
)
"""Options that apply to a single file, not to a stack."""


@dataclasses.dataclass(frozen=True, repr=False)
class StackCalibrateResult(Result):
    """The ranges of every file of a stack, by label."""

    output: Path
    files: Mapping[str, CalibrateResult]

    @property
    def headline(self) -> str:
        """The folder and the files."""
        return f"{self.output}: ranges of {', '.join(self.files)}"

    def tables(self) -> tuple[Table, ...]:
        """Return no table: the lines say what matters."""
        return ()

    def lines(self) -> tuple[str, ...]:
        """Return the lines of every file."""
        return tuple(line for each in self.files.values() for line in each.lines())

    def records(self) -> list[dict[str, object]]:
        """Return one row per file and tensor."""
        return [
            {"file": name, **record}
            for name, each in self.files.items()
            for record in each.records()
        ]

    def to_json(self) -> object:
        """Return the calibration of each file, by label."""
        return {"files": {name: each.to_json() for name, each in self.files.items()}}


def calibrate_stack(
    stack: str | Path,
    frames: str | Path | None,
    output: str | Path,
    options: CalibrateOptions | None = None,
    listener: Listener = SILENT,
) -> StackCalibrateResult:
    """Measure the ranges of every file in one run of the whole stack.

    The stack is a TOML with float files, and the frames are recorded for the stack. The
    output is a folder for ``compress --ranges``: ``head.json`` for the file ``head``.

    Raises:
        FramesError: There are no fitting frames, or an option is for one file alone.
        PreconditionError: A graph is quantized already, or nothing can become int8.
        GraphError: Files do not fit each other, or the folder would harm an input.
    """
    options, output = options or CalibrateOptions(), Path(output)
    # refuse what cannot be before the files are read
    for name in _OF_ONE_FILE:
        if getattr(options, name):
            word = name.replace("_", "-").replace("imported", "import")
            raise FramesError(f"--{word} is for one file: calibrate those of the stack")
    if frames is None:
        raise FramesError("give recorded frames: ranges are never made up")
    if output.suffix == ".json":
        raise GraphError(f"{output}: of a stack a folder is written: name one (-o)")
    # the folder is claimed before any work
    whole = SplitStack.load(model_path(stack))
    check_folder(output, (*whole.paths(), frames))
    with writing(trees=[output], force=options.force):
        found = _measured(whole, Path(frames), options, listener)
        return _written(found, output)


def _measured(
    whole: SplitStack, folder: Path, options: CalibrateOptions, listener: Listener
) -> dict[str, Ranges]:
    recording = CalibrationSet(folder)
    recording.check(whole.interface())
    part = draw(recording, options.count, options.seed)
    # files that can only stay float have no tensors to measure
    ready = _prepared(whole, options, listener)
    tensors = {name: _tensors(each) for name, each in ready.items()}
    if not any(tensors.values()):
        raise PreconditionError(f"{whole.path}: no node of any file can become int8")
    calibrator = StackCalibrator(options.method, options.threads, options.provider)
    return calibrator.run(
        whole,
        {name: each.model for name, each in ready.items()},
        tensors,
        part,
        lambda done, of: listener.on_progress("calibrate", done, of, options.method),
    )


def _prepared(
    whole: SplitStack, options: CalibrateOptions, listener: Listener
) -> dict[str, PreparedGraph]:
    passes = with_sizes(recipe.load(options.recipe), options.dims)
    modules = map_of_stack(whole, options.module_map)
    found = dict[str, PreparedGraph]()
    # the stack runs the prepared files, so that each must keep its outputs
    for label, each in whole.files.items():
        try_file(each.path, listener, options.provider)
        loaded = read_graph(each.path, listener)
        found[label] = PreparedGraph.of(each.path, loaded, modules, passes)
        held = {str(value.name) for value in found[label].model.graph.outputs}
        if gone := [name for name in each.outputs if name not in held]:
            raise PreconditionError(
                f"{label}: {options.recipe} takes its output {gone[0]} away, which"
                " the stack may read: calibrate that file alone"
            )
    return found


def _tensors(ready: PreparedGraph) -> tuple[str, ...]:
    """Name the tensors that need a range; none in a file that can only stay float."""
    try:
        return ready.tensors()
    except PreconditionError:
        return ()


def _written(found: Mapping[str, Ranges], output: Path) -> StackCalibrateResult:
    """Write the folder, all or nothing."""
    output.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=output.parent, prefix=f".{output.name}.") as scratch:
        draft = Path(scratch) / output.name
        draft.mkdir()
        for label, ranges in found.items():
            ranges.save(draft / f"{label}.json")
        drafts.put(draft, output)
    return StackCalibrateResult(
        output,
        {
            label: CalibrateResult(output / f"{label}.json", each.frames, each)
            for label, each in found.items()
        },
    )
