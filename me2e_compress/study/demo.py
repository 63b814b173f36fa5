"""The demo with a driver: compress it, then drive the same routes with both."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

from me2e_compress.evaluators.highway.engine import LocalEngine
from me2e_compress.quantization.plan import plan_of
from me2e_compress.simulator.routes import load_routes, pick_routes
from me2e_compress.study.condition import Condition
from me2e_compress.study.definition import Study, Timing, Variant
from me2e_compress.study.report.page import Section
from me2e_compress.study.run import run_study
from me2e_compress.study.study_result import StudyResult
from me2e_compress.study.verdict import before_and_after, road_verdict
from me2e_compress.study.workspace import HTML, JSON, MARKDOWN
from me2e_compress.study.write import StudyFiles, write_study
from me2e_compress.targets import DEFAULT_TARGET
from me2e_compress.workflows.checks import check_folder, check_ours
from me2e_compress.workflows.compare import CompareResult, compare
from me2e_compress.workflows.compress import CompressResult, beside, compress
from me2e_compress.workflows.files import export_stack
from me2e_compress.workflows.frames import record_frames
from me2e_compress.workflows.inspect import ModuleChanges, compare_modules
from me2e_compress.workflows.options import CompressOptions, FramesOptions
from me2e_compress.workflows.result import Listener, Result, Shown

CALIBRATION_FRAMES, HELD_OUT_FRAMES = 64, 24
LATENCY_SAMPLES, WORKERS = 100, 2
DRIVER, FLOAT, RECIPE = "highway", "float", "full-fused"
ROUTES = "5"
"""What both drive: a number of routes, or their names."""


@dataclasses.dataclass(frozen=True, repr=False)
class DriveResult(Result):
    """How the driver drives before and after compression."""

    study: StudyResult
    written: StudyFiles
    variant: str
    ending: tuple[str, ...]

    def shown(self) -> Shown:
        """Return size, time, plan and driving, before and after, and the verdict."""
        driven, whole = self.study.coverage
        return Shown(
            f"{driven} of {whole} routes, before and after",
            [before_and_after(self.study, self.variant)],
            (road_verdict(self.study, self.variant), *self.ending),
            self.study.alerts(),
        )

    def to_json(self) -> object:
        """Return the whole study as JSON."""
        return self.study.to_json()


@dataclasses.dataclass(frozen=True, repr=False)
class DemoResult(Result):
    """Of ``compress``, ``weigh``, ``compare`` and ``drive``, in this order."""

    steps: Mapping[str, Result]

    def shown(self) -> Shown:
        """Return the verdict of the last step, and the warnings of all."""
        *_, last = self.steps.values()
        alerts = [line for each in self.steps.values() for line in each.alerts()]
        return Shown(last.headline, last.tables(), last.lines(), alerts)

    def to_json(self) -> object:
        """Return the result of each step."""
        return {name: each.to_json() for name, each in self.steps.items()}


def figure(result: Result) -> str:
    """Return a step's result, short enough for a line of a terminal."""
    return result.size if isinstance(result, CompressResult) else result.headline


@dataclasses.dataclass(frozen=True)
class DriverDemo:
    """Compress the shipped driver and compare both, on frames and on the road.

    Attributes:
        out: The folder that everything is written to.
        force: Replace files that we did not write, too.

    Raises:
        GraphError: The output folder is a file, or a user's file would be overwritten.
    """

    out: Path
    force: bool = False
    _told: list[Section] = dataclasses.field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        """Check the outputs first: the work takes minutes."""
        check_folder(self.out, ())
        records = (beside(self._small, what) for what in ("report", "plan"))
        pages = (self.out / name for name in (JSON, MARKDOWN, HTML))
        check_ours(
            [self._source, self._small, *records, *pages],
            trees=[self._frames, self._held_out],
            force=self.force,
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
        self._record(listener)
        found = self._compressed(listener)
        self._told.append(Section("The passes", found.tables()))
        plan = plan_of(found.report.model)
        if plan is not None:
            self._told.append(Section("What became int8", plan.tables()))
        return found

    def weigh(self, listener: Listener) -> ModuleChanges:
        """Compare the modules before and after."""
        found = compare_modules(self._source, self._small)
        self._told.append(Section("The modules", found.tables()))
        return found

    def compare(self, listener: Listener) -> CompareResult:
        """Compare the compressed graph with the driver on other frames."""
        graphs = self._source, self._small
        found = compare(*graphs, self._held_out, listener=listener)
        self._told.append(Section("The outputs", found.tables()))
        return found

    def drive(self, listener: Listener) -> DriveResult:
        """Drive the routes with both, and write the report."""
        # a study of two variants under ideal conditions
        everything = load_routes()
        study = Study(
            f"{DRIVER} before and after {RECIPE}",
            (
                Variant(FLOAT, str(self._source)),
                Variant(RECIPE, str(self._small)),
            ),
            (Condition("ideal", "none"),),
            FLOAT,
            pick_routes(everything, ROUTES),
            len(everything),
            held_out=self._held_out,
            timing=Timing(LATENCY_SAMPLES),
        )
        # run it, and write its report with the demo's own sections
        engine = LocalEngine(WORKERS)
        found = run_study(study, self.out, engine, listener, 1, force=self.force)
        told = (*self._told, self._files())
        written = write_study(found, self.out, self._words(), told, force=self.force)
        ending = (
            f"{self._small} is yours; {written.report} tells all of it.",
            *self._elsewhere(),
        )
        return DriveResult(found, written, RECIPE, ending)

    def _record(self, listener: Listener) -> None:
        """Record frames to calibrate on, and others to compare on, of the next seed."""
        folders = {self._frames: CALIBRATION_FRAMES, self._held_out: HELD_OUT_FRAMES}
        for seed, (folder, count) in enumerate(folders.items()):
            asked = FramesOptions(count=count, seed=seed, force=self.force)
            record_frames(self._source, folder, asked, listener)

    def _compressed(self, listener: Listener) -> CompressResult:
        """Compress on the recorded frames."""
        # fidelity is measured on frames of another seed, see `compare`
        options = CompressOptions(
            target=DEFAULT_TARGET, measure_frames=0, allow_empty=True, force=self.force
        )
        return compress(
            self._source, self._small, RECIPE, self._frames, options, listener
        )

    @property
    def _source(self) -> Path:
        return self.out / f"{DRIVER}.onnx"

    @property
    def _small(self) -> Path:
        return self.out / f"{DRIVER}.{RECIPE}.onnx"

    @property
    def _frames(self) -> Path:
        return self.out / "frames"

    @property
    def _held_out(self) -> Path:
        return self.out / "frames-held-out"

    def _files(self) -> Section:
        """List the files linked from the page."""
        report, plan = (beside(self._small, what) for what in ("report", "plan"))
        files = (
            ("the driver", self._source),
            ("the small one", self._small),
            ("pass by pass", report),
            ("node by node", plan),
            ("calibration", self._frames),
            ("held out", self._held_out),
            ("drives", self.out / "results"),
        )
        there = ((words, path.name) for words, path in files if path.exists())
        return Section("Files", files=(*there, ("for programs", JSON)))

    def _words(self) -> tuple[str, ...]:
        return ("me2e-compress", "demo", "-o", str(self.out))

    def _elsewhere(self) -> tuple[str, ...]:
        """Say how to compress for TensorRT."""
        return (
            f"Its int8 is for {DEFAULT_TARGET}, which drives here. For TensorRT:",
            f"  me2e-compress compress {DRIVER} -r {RECIPE} --target"
            f" tensorrt --frames {self._frames} -o {DRIVER}.trt.onnx",
        )
