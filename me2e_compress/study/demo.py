"""The demo with a driver: compress it, then drive the same routes with both."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

from me2e_compress.base.display import Cell, Table
from me2e_compress.base.listener import Listener
from me2e_compress.commands.checks import check_folder, check_replaceable
from me2e_compress.commands.compare import CompareResult, compare
from me2e_compress.commands.compress import CompressResult, compress, sidecar
from me2e_compress.commands.files import export_stack
from me2e_compress.commands.frames import record_frames
from me2e_compress.commands.inspect import InspectResult, inspect
from me2e_compress.commands.options import CompressOptions, FramesOptions
from me2e_compress.commands.result import Result, View
from me2e_compress.evaluators.highway.engine import LocalEngine
from me2e_compress.simulator.routes import load_routes, pick_routes
from me2e_compress.study.cells import MISSING, estimate_cell, measure_cell
from me2e_compress.study.condition import Condition
from me2e_compress.study.definition import Study, Timing, Variant
from me2e_compress.study.report.page import findings, limits, write_study
from me2e_compress.study.run import run_study
from me2e_compress.study.study_result import StudyResult
from me2e_compress.study.workspace import HTML, JSON, MARKDOWN
from me2e_compress.targets import DEFAULT_TARGET

CALIBRATION_FRAMES, HELD_OUT_FRAMES = 64, 24
LATENCY_SAMPLES, WORKERS = 100, 2
DRIVER, FLOAT, RECIPE = "highway", "float", "full-fused"
ROUTES = "5"  # a number of routes that both drive, or their names


@dataclasses.dataclass(frozen=True, repr=False)
class DriveResult(Result):
    """How the driver drives before and after compression."""

    keys = ("*study",)
    study: StudyResult
    ending: tuple[str, ...]

    def view(self) -> View:
        """Return size, time, plan and driving, before and after, and the verdict."""
        # A row a drive, whose costs are its variant's
        rows, (driven, whole) = list[tuple[Cell, ...]](), self.study.coverage
        for drive in self.study.drives:
            variant, gap = self.study.variant(drive.variant), drive.difference
            score, moved = Cell(MISSING), Cell(MISSING, reason="the baseline itself")
            if drive.scores is not None:
                score = estimate_cell(drive.scores.driving_score)
            if gap is not None:
                moved = estimate_cell(gap.driving_score, signed=True)
            costs = (
                measure_cell(variant.size_mb, ".2f"),
                measure_cell(variant.latency_ms[50], ".1f"),
                measure_cell(variant.fidelity.plan_mean, ".3f"),
                measure_cell(variant.fidelity.plan_max, ".2f"),
            )
            rows.append((Cell(self.study.label(drive)), *costs, score, moved))
        columns = ("", "MB", "ms", "plan m", "at most", "driving score", "difference")
        note = "ms: median of a decision; plan: metres that waypoints move."
        return View(
            f"{driven} of {whole} routes, before and after",
            [Table("Before and after", columns, tuple(rows), note)],
            (*map(": ".join, findings(self.study)), limits(self.study), *self.ending),
            self.study.alerts(),
        )


@dataclasses.dataclass(frozen=True, repr=False)
class DemoResult(Result):
    """Of ``compress``, ``weigh``, ``compare`` and ``drive``, in this order."""

    keys = ("*steps",)
    steps: Mapping[str, Result]

    def view(self) -> View:
        """Return the verdict of the last step, and the warnings of all."""
        *_, last = self.steps.values()
        alerts = [line for step in self.steps.values() for line in step.alerts()]
        return View(last.headline, last.tables(), last.lines(), alerts)


class DriverDemo:
    """Compress the shipped driver and compare both, on frames and on the road.

    ``out`` is the folder of all files; ``force`` replaces files that we did not write.
    Outputs are checked first, since the work takes minutes.
    """

    def __init__(self, out: Path, force: bool = False) -> None:
        self.out, self.force = out, force
        self._source = out / f"{DRIVER}.onnx"
        self._small = out / f"{DRIVER}.{RECIPE}.onnx"
        self._frames, self._held_out = out / "frames", out / "frames-held-out"
        check_folder(out, ())
        records = (sidecar(self._small, what) for what in ("report", "plan"))
        pages = (out / name for name in (JSON, MARKDOWN, HTML))
        check_replaceable(
            [self._source, self._small, *records, *pages],
            trees=[self._frames, self._held_out],
            force=force,
        )

    @property
    def steps(self) -> dict[str, Callable[[Listener], Result]]:
        """The steps by name, in order."""
        return {
            "compress": self.compress,
            "weigh": self.weigh,
            "compare": self.compare,
            "drive": self.drive,
        }

    def compress(self, listener: Listener) -> CompressResult:
        """Copy the driver, record frames, and compress it."""
        export_stack(DRIVER, self._source, force=self.force)
        # Frames to calibrate on, and others to compare on, of the next seed
        folders = {self._frames: CALIBRATION_FRAMES, self._held_out: HELD_OUT_FRAMES}
        for seed, (folder, count) in enumerate(folders.items()):
            frames = FramesOptions(count=count, seed=seed, force=self.force)
            record_frames(self._source, folder, frames, listener)
        # Fidelity is measured on frames of another seed, see `compare`
        options = CompressOptions(
            target=DEFAULT_TARGET, measure_frames=0, allow_empty=True, force=self.force
        )
        return compress(
            self._source, self._small, RECIPE, self._frames, options, listener
        )

    def weigh(self, listener: Listener) -> InspectResult:
        """Weigh the modules of what was compressed."""
        return inspect(self._small)

    def compare(self, listener: Listener) -> CompareResult:
        """Compare the compressed graph with the driver on other frames."""
        return compare(self._source, self._small, self._held_out, listener=listener)

    def drive(self, listener: Listener) -> DriveResult:
        """Drive the routes with both, and write the report."""
        # A study of two variants under ideal conditions
        everything = load_routes()
        study = Study(
            f"{DRIVER} before and after {RECIPE}",
            (Variant(FLOAT, str(self._source)), Variant(RECIPE, str(self._small))),
            (Condition("ideal", "none"),),
            FLOAT,
            pick_routes(everything, ROUTES),
            len(everything),
            held_out=self._held_out,
            timing=Timing(LATENCY_SAMPLES),
        )
        engine = LocalEngine(WORKERS)
        result = run_study(study, self.out, engine, listener, force=self.force)
        words = ("me2e-compress", "demo", "-o", str(self.out))
        written = write_study(result, self.out, words, force=self.force)
        ending = (
            f"{self._small} is yours; {written.report} tells how it drives.",
            f"Its int8 is for {DEFAULT_TARGET}, which drives here. For TensorRT:",
            f"  me2e-compress compress {DRIVER} -r {RECIPE} --target"
            f" tensorrt --frames {self._frames} -o {DRIVER}.trt.onnx",
        )
        return DriveResult(result, ending)
