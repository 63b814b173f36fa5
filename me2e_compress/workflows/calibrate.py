"""Calibrate int8: measure or import the ranges of tensors."""

import dataclasses
import gc
from pathlib import Path

from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.exchange import (
    TABLE_FILES,
    read_cache,
    taken_from,
    write_onnxruntime_table,
    write_tensorrt_cache,
)
from me2e_compress.calibration.observers import OBSERVERS
from me2e_compress.calibration.ranges import Ranges, rms_of
from me2e_compress.calibration.review import not_in, review
from me2e_compress.calibration.sample import FrameSubset, draw
from me2e_compress.errors import FramesError
from me2e_compress.manager import recipe
from me2e_compress.quantization.decision import keep_readers, overrides_text
from me2e_compress.registry import drafts
from me2e_compress.runtime.atomic import write_bytes
from me2e_compress.workflows.calibrate_options import (
    CalibrateOptions,
    checkpoint_beside,
    overrides_beside,
    written_files,
)
from me2e_compress.workflows.calibrate_result import CalibrateResult
from me2e_compress.workflows.checks import (
    check_folder,
    model_path,
    output_path,
    read_graph,
)
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.first_opening import try_first
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.prepare_int8 import PreparedGraph


def calibrate(
    model: str | Path,
    frames: str | Path | None,
    output: str | Path,
    options: CalibrateOptions | None = None,
    listener: Listener = SILENT,
) -> CalibrateResult:
    """Measure the ranges of every tensor that any scheme, rule set or target needs.

    The model is a float ONNX file or the name of one that ships; frames may be None to
    import another tool's ranges. The output is ``RANGES.json``. Tensors that an
    imported cache lacks are kept in float by ``RANGES.overrides.toml``. A run that was
    killed goes on from ``OUTPUT.checkpoint``.

    Raises:
        FramesError: There is no source, or frames or a cache do not fit.
        PreconditionError: The graph is quantized already, or nothing can become int8.
        GraphError: The model does not exist, or an output would harm an input.
        RecipeError: The recipe does not exist.
        ProviderError: The provider is not available.
    """
    options = options or CalibrateOptions()
    source, output = model_path(model), output_path(output)
    if frames is None and options.imported is None:
        raise FramesError(
            "give recorded frames, or another tool's cache (--import, frames then judge"
            " its scales); ranges are never made up"
        )
    named = (options.recipe, options.module_map, options.imported, options.adapter)
    outputs = written_files(output, options)
    inputs = (source, frames, *named)
    if options.onnxruntime_table is not None:
        check_folder(Path(options.onnxruntime_table), inputs, TABLE_FILES)
    with writing(outputs, inputs, force=options.force):
        ready, part = _ready(source, frames, options, listener)
        gc.collect()  # 150 MB of VAD-tiny as it was read; graphs are cycles
        with drafts.all_or_none():
            if options.imported is not None:
                return _import(ready, Path(options.imported), part, output, options)
            assert part is not None
            return _calibrate(ready, part, output, options, listener)


def _ready(
    source: Path,
    frames: str | Path | None,
    options: CalibrateOptions,
    listener: Listener,
) -> tuple[PreparedGraph, FrameSubset | None]:
    """Read the graph and its frames, and run the passes before int8.

    Ranges belong to the graph as these passes leave it.
    """
    loaded = read_graph(source, listener, options.adapter, options.module_map)
    # what is read is checked, and the graph is opened, before any pass runs
    if options.imported is not None:
        read_cache(Path(options.imported))
    part = None
    if frames is not None:
        recording = CalibrationSet(frames)
        recording.check(loaded)
        part = draw(recording, options.count, 0)
    try_first(
        loaded,
        source.name,
        listener=listener,
        file=source,
        frames=part,
        provider=options.provider,
    )
    passes = recipe.load(options.recipe)
    return PreparedGraph.of(source, loaded, options.module_map, passes), part


def _calibrate(
    ready: PreparedGraph,
    part: FrameSubset,
    output: Path,
    options: CalibrateOptions,
    listener: Listener,
) -> CalibrateResult:
    tensors = ready.tensors()
    # a checkpoint lets a run that was killed go on
    method = options.method or ready.method
    checkpoint = checkpoint_beside(output)
    calibrator = Calibrator(
        method, options.threads, checkpoint=checkpoint, provider=options.provider
    )
    seen = calibrator.collect(
        ready.model,
        tensors,
        part,
        lambda done, of: listener.on_progress("calibrate", done, of, method),
    )
    return _written(Ranges.of(seen, OBSERVERS.parse(method)), output, options)


def _import(
    ready: PreparedGraph,
    path: Path,
    part: FrameSubset | None,
    output: Path,
    options: CalibrateOptions,
) -> CalibrateResult:
    """Take another tool's ranges; keep in float what has none."""
    cache, tensors = read_cache(path), ready.tensors()
    found = taken_from(cache, path, ready.model, tensors)
    missing = [name for name in tensors if name not in found.tensors]
    # two frames show the size of every tensor; the second has a state
    if part is not None:
        few = dataclasses.replace(part, places=part.places[:2])
        calibrator = Calibrator(threads=options.threads, provider=options.provider)
        seen = calibrator.collect(ready.model, tuple(found.tensors), few)
        found = dataclasses.replace(found, rms=rms_of(seen))
    made = _written(found, output, options)
    overrides = overrides_beside(output) if missing else None
    if overrides is not None:
        floats = (keep_readers(name, f"not in {path.name}") for name in missing)
        text = drafts.IN_TOML + overrides_text(floats)
        write_bytes(overrides, text.encode())
    return dataclasses.replace(
        made, findings=(*not_in(path, missing), *made.findings), overrides=overrides
    )


def _written(found: Ranges, output: Path, options: CalibrateOptions) -> CalibrateResult:
    found.save(output)
    if options.tensorrt_cache is not None:
        write_tensorrt_cache(found, Path(options.tensorrt_cache))
    if options.onnxruntime_table is not None:
        write_onnxruntime_table(found, Path(options.onnxruntime_table))
    return CalibrateResult(output, found.frames, found, findings=review(found))
