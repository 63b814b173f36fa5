"""Calibrate int8: measure or import the ranges of tensors, and look at them."""

import dataclasses
import gc
from pathlib import Path

from me2e_compress.base import atomic
from me2e_compress.base.atomic import write_bytes
from me2e_compress.base.display import plural
from me2e_compress.base.errors import FramesError
from me2e_compress.base.listener import SILENT, Listener
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet, draw
from me2e_compress.calibration.exchange import pick_ranges, read_cache
from me2e_compress.calibration.observers import OBSERVERS
from me2e_compress.calibration.ranges import (
    RangeFinding,
    Ranges,
    missing_ranges,
    review,
    rms_of,
)
from me2e_compress.commands.checks import (
    model_path,
    output_path,
    read_graph,
    try_first,
    writing,
)
from me2e_compress.commands.options import CalibrateOptions
from me2e_compress.commands.plan import PreparedGraph
from me2e_compress.commands.result import Result, View
from me2e_compress.manager import recipe
from me2e_compress.quantization.decision import keep_readers, overrides_text


@dataclasses.dataclass(frozen=True, repr=False)
class CalibrateResult(Result):
    """The range of every tensor."""

    output: Path
    frames: int
    ranges: Ranges
    findings: tuple[RangeFinding, ...] = ()  # ranges that deserve a look
    # The file that leaves in float what an imported cache has no range for
    overrides: Path | None = None

    def view(self) -> View:
        """Return the ranges that deserve a look, and how to keep floats."""
        ranges = self.ranges
        headline = (
            f"{self.output}: {plural(len(ranges.tensors), 'tensor')}, {ranges.method},"
            f" {plural(ranges.frames, 'frame')}"
        )
        lines, alerts = [headline], list[str]()
        for finding in self.findings:
            place = alerts if finding.severity == "warning" else lines
            place.append(str(finding))
        if self.overrides is not None:
            how = f"compress --ranges {self.output} --overrides {self.overrides}"
            alerts.append(f"These floats: {how}")
        return View(headline, lines=lines, alerts=alerts)

    def to_json(self) -> object:
        """Return the ranges and the tensors that are always zero."""
        return {
            **dataclasses.asdict(self.ranges),
            "dead": self.ranges.dead,
            "outliers": self.ranges.outliers,
            "findings": self.findings,
            "overrides": self.overrides,
        }


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
    inputs = (source, frames, *named)
    # Progress, and overrides for tensors that an imported cache lacks, lie beside
    checkpoint = output.with_name(output.name + ".checkpoint")
    overrides = output.with_name(f"{output.stem}.overrides.toml")
    outputs = [output, checkpoint]
    outputs += [] if options.imported is None else [overrides]
    with writing(outputs, inputs, force=options.force):
        # Inputs are checked, and the graph is opened, before any pass runs
        loaded = read_graph(source, listener, options.adapter, options.module_map)
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
            provider=options.runs_on,
        )
        # Run the passes before int8; ranges are of the graph that they leave
        passes = recipe.load(options.recipe)
        prepared = PreparedGraph.of(source, loaded, options.module_map, passes)
        del loaded
        gc.collect()  # 150 MB of VAD-tiny as it was read; graphs are cycles
        with atomic.all_or_none():
            missing = list[str]()
            if options.imported is not None:
                ranges, missing = _import(prepared, part, options)
            else:
                # A run that was killed goes on from the checkpoint
                assert part is not None
                method = options.method or prepared.method
                calibrator = Calibrator(
                    method, checkpoint=checkpoint, provider=options.runs_on
                )
                report = listener.counting("calibrate", method)
                statistics = calibrator.collect(
                    prepared.model, prepared.tensors(), part, report
                )
                ranges = Ranges.of(statistics, OBSERVERS.parse(method))
            ranges.save(output)
            # Tensors without a range in an imported cache stay in float
            cache = Path(options.imported or "")
            if missing:
                absent = f"not in {cache.name}"
                floats = (keep_readers(name, absent) for name in missing)
                text = atomic.IN_TOML + overrides_text(floats)
                write_bytes(overrides, text.encode())
    findings = (*missing_ranges(cache, missing), *review(ranges))
    written = overrides if missing else None
    return CalibrateResult(output, ranges.frames, ranges, findings, written)


def _import(
    prepared: PreparedGraph, part: CalibrationSet | None, options: CalibrateOptions
) -> tuple[Ranges, list[str]]:
    """Return another tool's ranges, and the tensors that it has none for."""
    path, tensors = Path(options.imported or ""), prepared.tensors()
    ranges = pick_ranges(read_cache(path), path, prepared.model, tensors)
    # two frames show the size of every tensor; the second has a state
    if part is not None:
        few = part.part(part.places[:2])
        calibrator = Calibrator(provider=options.runs_on)
        statistics = calibrator.collect(prepared.model, tuple(ranges.tensors), few)
        ranges = dataclasses.replace(ranges, rms=rms_of(statistics))
    return ranges, [name for name in tensors if name not in ranges.tensors]
