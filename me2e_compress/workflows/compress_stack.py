"""Compress a stack of several files, file by file, and measure it as one model."""

import dataclasses
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time

import numpy as np

from me2e_compress import drafts, marks
from me2e_compress.calibration.part_frames import PartFrames
from me2e_compress.calibration.sample import FrameSubset
from me2e_compress.calibration.stream import Recording
from me2e_compress.errors import (
    EvaluationError,
    FramesError,
    GraphError,
    PreconditionError,
    RecipeError,
)
from me2e_compress.fidelity.compare import compare
from me2e_compress.fidelity.floor import Floor
from me2e_compress.manager.pass_manager import collector_paused
from me2e_compress.passes import Pass
from me2e_compress.runtime.atomic import write_bytes, write_document
from me2e_compress.runtime.frames import Frames
from me2e_compress.runtime.stack.split_stack import SplitStack
from me2e_compress.runtime.stack.stack_file import PartEntry
from me2e_compress.runtime.stack.stack_session import StackSession
from me2e_compress.workflows.checks import check_folder, model_path, read_graph
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.compress import (
    CompressOptions,
    Recipe,
    compress_graph,
)
from me2e_compress.workflows.compress_fidelity import MeasuredLoss, SplitFrames
from me2e_compress.workflows.compress_result import CompressResult
from me2e_compress.workflows.compress_stack_result import (
    REPORT,
    StackCompressResult,
    stack_record,
)
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.stack_maps import map_of_stack

Pipelines = Mapping[str, tuple[Pass, ...]]
"""The passes of every file, by label."""


def compress_stack(
    stack: str | Path,
    output: str | Path,
    recipe: Recipe | None = None,
    frames: str | Path | None = None,
    options: CompressOptions | None = None,
    listener: Listener = SILENT,
) -> StackCompressResult:
    """Compress every file of a stack, and write a folder with the smaller stack.

    Each file is calibrated and checked on what it is fed while the float stack runs
    over the frames; then the whole is compared with the float stack. The folder holds a
    TOML of the same name, the files, their plans and reports, and ``report.json``. A
    recipe of None takes what the TOML says of each file; the option ``ranges`` is a
    folder of :func:`calibrate_stack`.

    Raises:
        GraphError: Files do not fit each other, or the folder would harm an input.
        RecipeError: There is nothing to do for a file, or options do not fit the
            passes.
        FramesError: The frames do not fit the stack.
        PreconditionError: Nothing became int8 in any file although passes quantize.
        Me2eError: A pass refused a graph or failed.
    """
    options, output = options or CompressOptions(), Path(output)
    if output.suffix in (".onnx", ".toml"):
        raise GraphError(f"{output}: a stack is written as a folder: name one")
    if options.adapter is not None:
        raise RecipeError(f"--adapter is for one file: {stack} says state and plan")
    whole = SplitStack.load(model_path(stack))
    pipelines = _pipelines(whole, recipe, options)
    check_folder(output, (*whole.paths(), frames))
    with (
        writing(trees=[output], force=options.force),
        collector_paused(),
        _drafted(output) as draft,
    ):
        return _compress(whole, draft, output, pipelines, frames, options, listener)


@contextmanager
def _drafted(output: Path) -> Iterator[Path]:
    """Make a draft folder, which takes the output's place at the end."""
    output.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=output.parent, prefix=f".{output.name}.") as scratch:
        draft = Path(scratch) / output.name
        draft.mkdir()
        try:
            yield draft
        except GraphError as error:
            raise GraphError(str(error).replace(str(draft), str(output))) from error
        drafts.put(draft, output)


def _compress(
    whole: SplitStack,
    draft: Path,
    output: Path,
    pipelines: Pipelines,
    frames: str | Path | None,
    options: CompressOptions,
    listener: Listener,
) -> StackCompressResult:
    start = process_time()
    passes = [each for every in pipelines.values() for each in every]
    most = options.measure_frames
    split = SplitFrames.read(frames, whole.interface(), passes, most)
    modules = map_of_stack(whole, options.module_map)
    # every file is compressed on its own inputs within the running float stack
    found = {
        label: compress_graph(
            read_graph(each.path, listener),
            (each.path, draft / f"{label}.onnx", output.parent),
            pipelines[label],
            modules,
            _of_part(whole, label, split, options),
            _options_of(label, options),
            _told_of(label, listener),
        )
        for label, each in whole.files.items()
    }
    _refuse_empty(found, options)
    # the whole is measured as one model, because the files' losses do not add up
    small = SplitStack.load(_write_toml(whole, draft))
    loss = _measured(whole, small, split, found, options)
    record = stack_record(whole, small, found, loss)
    write_document(draft / REPORT, record, indent=2)
    seconds = process_time() - start
    # results name the files where the draft will be put
    moved = {
        label: dataclasses.replace(each, output=output / each.output.name)
        for label, each in found.items()
    }
    source, target = whole.path, output / whole.path.name
    return StackCompressResult(source, target, moved, record, loss, seconds)


def _pipelines(
    whole: SplitStack, recipe: Recipe | None, options: CompressOptions
) -> Pipelines:
    entries = {each.name: each for each in whole.content.part}
    found = dict[str, tuple[Pass, ...]]()
    for label, file in whole.files.items():
        wanted = recipe or _named(entries[file.part], whole.path.parent)
        try:
            passes = _options_of(label, options).passes(wanted)
        except RecipeError as error:
            raise RecipeError(f"{label}: {error}") from error
        found[label] = passes
    return found


def _named(entry: PartEntry, folder: Path) -> str | Path | None:
    """Return the recipe of a part: a file beside the TOML, else one that ships."""
    if entry.recipe is None:
        return None
    beside = folder / entry.recipe
    return beside if beside.is_file() else entry.recipe


def _options_of(label: str, options: CompressOptions) -> CompressOptions:
    """Return the options of one file: its own ranges, and leave to stay float."""
    ranges = None if options.ranges is None else Path(options.ranges) / f"{label}.json"
    return dataclasses.replace(options, ranges=ranges, allow_empty=True)


def _of_part(
    whole: SplitStack, label: str, split: SplitFrames, options: CompressOptions
) -> SplitFrames:
    """Return the frames that one file is fed while the stack runs."""

    def fed(frames: Recording) -> PartFrames:
        return PartFrames(whole, label, frames, options.provider)

    calibration = None if split.calibration is None else fed(split.calibration)
    if not isinstance(split.measured, FrameSubset):
        return SplitFrames(calibration, None, split.kind)
    try:
        measured: Frames = tuple(fed(split.measured))
    except FramesError as error:
        return SplitFrames(calibration, None, str(error))
    return SplitFrames(calibration, measured, split.kind)


def _told_of(label: str, listener: Listener) -> Listener:
    """Put the file's label before progress and warnings."""
    return Listener(
        lambda stage, done, total, words: listener.on_progress(
            f"{label}: {stage}", done, total, words
        ),
        lambda line: listener.on_warning(f"{label}: {line}"),
    )


def _refuse_empty(
    found: Mapping[str, CompressResult], options: CompressOptions
) -> None:
    outcomes = [each.int8 for each in found.values() if each.int8 is not None]
    if outcomes and not options.allow_empty and all(each.empty for each in outcomes):
        raise PreconditionError(
            f"{outcomes[0].empty}; nothing is written, --allow-empty writes it"
            " nevertheless"
        )


def _write_toml(whole: SplitStack, draft: Path) -> Path:
    """Write the TOML of the smaller stack, and first values as files beside it."""
    # parts lie beside the TOML under their own names; the recipes are done
    said = whole.content
    parts = tuple(
        each.model_copy(
            update={
                "file": each.file and Path(f"{each.name}.onnx"),
                "first_frame": each.first_frame
                and Path(f"{each.name}.first_frame.onnx"),
                "recipe": None,
            }
        )
        for each in said.part
    )
    state = dict(said.state)
    # first values become files, because their sources may lie elsewhere
    for at, (name, entry) in enumerate(said.state.items()):
        value = whole.first_values.get(name.removeprefix(f"{name.split('.')[0]}."))
        value = whole.first_values.get(name, value)
        if value is not None:
            file = draft / f"first_value_{at}.npy"
            with file.open("wb") as stream:
                np.save(stream, value, allow_pickle=False)
                stream.write(marks.BYTES)
            state[name] = entry.model_copy(update={"first": file.name})
    path = draft / whole.path.name
    small = said.model_copy(update={"part": parts, "state": state})
    write_bytes(path, (marks.IN_TOML + small.text()).encode())
    return path


def _measured(
    whole: SplitStack,
    small: SplitStack,
    split: SplitFrames,
    found: Mapping[str, CompressResult],
    options: CompressOptions,
) -> MeasuredLoss | None:
    """Compare the whole with the float stack, if any file had a lossy pass."""
    if not any(each.report.lossy for each in found.values()):
        return None
    floor = Floor(options.floor)
    if split.measured is None:
        return MeasuredLoss(None, split.kind, floor)
    before, after = (
        StackSession.open(each, release=True, provider=options.provider)
        for each in (whole, small)
    )
    # outputs that are unsteady within a file are not judged in the whole either
    unsteady = {
        name: value
        for each in found.values()
        if each.loss is not None
        for name, value in each.loss.unsteady.items()
    }
    try:
        fidelity = compare(before, after, split.measured)
    except EvaluationError as error:
        return MeasuredLoss(None, str(error), floor, incomparable=True)
    # every file with a lossy pass shares the blame
    below = floor.shortfalls(fidelity, unsteady)
    guilty = tuple(name for name, each in found.items() if each.report.lossy)
    unsteady = {name: unsteady[name] for name in unsteady if name in whole.outputs}
    return MeasuredLoss(fidelity, split.kind, floor, unsteady, tuple(below), guilty)
