"""The demo with a driver: compressed, then both drive the same routes."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

from me2e_compress import recipe
from me2e_compress.evaluators.highway.engine import LocalEngine
from me2e_compress.runtime.providers import CPU, PROVIDERS, Provider
from me2e_compress.simulator.routes import load_routes, pick_routes
from me2e_compress.study.condition import Condition
from me2e_compress.study.definition import Study, Timing, Variant
from me2e_compress.study.outcome import StudyResult
from me2e_compress.study.run import run_study
from me2e_compress.study.tables import differences, scoreboards
from me2e_compress.study.verdict import verdict
from me2e_compress.study.write import StudyFiles, write_study
from me2e_compress.workflows.checks import check_folder
from me2e_compress.workflows.compare import compare
from me2e_compress.workflows.compress import CompressOptions, compress
from me2e_compress.workflows.compress_result import CompressResult
from me2e_compress.workflows.export import ExportOptions, export_stack
from me2e_compress.workflows.frames import FramesOptions, record_frames
from me2e_compress.workflows.listener import Listener
from me2e_compress.workflows.module_changes import ModuleChanges, compare_modules
from me2e_compress.workflows.result import Result, Table

CALIBRATION_FRAMES, CALIBRATION_SEED = 64, 0
HELD_OUT_FRAMES, HELD_OUT_SEED = 24, 1
LATENCY_SAMPLES = 100
FLOAT = "float"


@dataclasses.dataclass(frozen=True, repr=False)
class DriveResult(Result):
    """How the driver drives before and after.

    Attributes:
        study: everything that was found.
        written: its files.
        ending: the verdict, and what the user has now.
    """

    study: StudyResult
    written: StudyFiles
    ending: tuple[str, ...]

    @property
    def headline(self) -> str:
        """Size, time and plan, in one line."""
        return self.ending[0]

    def lines(self) -> tuple[str, ...]:
        """Return the verdict, what the user has, and another target's command."""
        return self.ending

    def tables(self) -> tuple[Table, ...]:
        """Return scoreboard and differences."""
        return (*scoreboards(self.study), differences(self.study))

    def records(self) -> list[dict[str, object]]:
        """Return a row a drive."""
        return self.study.records()

    def to_json(self) -> object:
        """Return everything that was found."""
        return self.study.to_json()


@dataclasses.dataclass(frozen=True)
class DriverDemo:
    """The driver that ships, compressed, and both held against each other.

    Attributes:
        name: of the driver.
        out: the folder.
        scheme: a shipped recipe.
        routes: that both drive: a number or ``ID,ID``.
        workers: routes at a time.
        provider: what runs the graphs.
        force: replace files that are not as we left them, too.

    Raises:
        RecipeError: no such recipe.
        EvaluationError: no such route.
        GraphError: the folder is a file.
    """

    name: str
    out: Path
    scheme: str = "feature-ext"
    routes: str = "5"
    workers: int = 2
    provider: Provider = CPU
    force: bool = False

    def __post_init__(self) -> None:
        """Check recipe, routes and folder."""
        recipe.load(self.scheme)
        pick_routes(load_routes(), self.routes)
        check_folder(self.out, ())

    @property
    def steps(self) -> dict[str, Callable[[Listener], Result]]:
        """What is done, by name, in order."""
        return {
            "compress": self.compress,
            "weigh": self.weigh,
            "compare": self.compare,
            "drive": self.drive,
        }

    def compress(self, listener: Listener) -> CompressResult:
        """Copy the driver, let it see routes, make it small.

        Int8 is for what drives here: placed for TensorRT it is slower than float on
        the CPU.
        """
        export_stack(self.name, self._source, ExportOptions(force=self.force))
        for folder, count, seed in (
            (self._frames, CALIBRATION_FRAMES, CALIBRATION_SEED),
            (self._held_out, HELD_OUT_FRAMES, HELD_OUT_SEED),
        ):
            asked = FramesOptions(count, seed, provider=self.provider, force=self.force)
            record_frames(self._source, folder, asked, listener)
        passes = recipe.load(self.scheme)
        quantizes = any(each.quantizes for each in passes)
        target = self.provider.target if quantizes else None
        # Fidelity is measured on frames of other routes, see `compare`.
        options = CompressOptions(
            target=target,
            measure_frames=0,
            allow_empty=True,
            provider=self.provider,
            force=self.force,
        )
        return compress(
            self._source, self._small, passes, self._frames, options, listener
        )

    def weigh(self, listener: Listener) -> ModuleChanges:
        """Weigh the modules before and after."""
        return compare_modules(self._source, self._small)

    def compare(self, listener: Listener) -> Result:
        """Compare the small graph with the driver on other frames."""
        return compare(
            self._source,
            self._small,
            self._held_out,
            listener,
            provider=self.provider,
        )

    def drive(self, listener: Listener) -> DriveResult:
        """Drive the routes with both, and write the report."""
        everything = load_routes()
        study = Study(
            f"{self.name} before and after {self.scheme}",
            (
                Variant(FLOAT, str(self._source)),
                Variant(self.scheme, str(self._small)),
            ),
            (Condition("ideal", "none"),),
            FLOAT,
            pick_routes(everything, self.routes),
            len(everything),
            held_out=self._held_out,
            timing=Timing(LATENCY_SAMPLES),
            provider=self.provider,
        )
        engine = LocalEngine(self.workers)
        found = run_study(study, self.out, engine, listener, force=self.force)
        written = write_study(found, self.out, self._words(), force=self.force)
        ending = (
            *verdict(found, self.scheme),
            f"{self._small} and {written.report} are yours.",
            *self._elsewhere(),
        )
        return DriveResult(found, written, ending)

    def _words(self) -> tuple[str, ...]:
        """Return the command that does all this."""
        words = ("me2e-compress", "demo", "-o", str(self.out))
        chosen = ["--routes", self.routes, "--scheme", self.scheme]
        if self.provider != CPU:
            chosen += ["--provider", PROVIDERS.text(self.provider)]
        return (*words, *chosen)

    def _elsewhere(self) -> tuple[str, ...]:
        """Say what to do for TensorRT, where that does not drive here."""
        target = self.provider.target
        if target == "tensorrt":
            return ()
        return (
            f"Its int8 is for {target}, which drives here. For TensorRT: me2e-compress"
            f" compress {self.name} -r {self.scheme} --frames {self._frames} -o"
            f" {self.name}.trt.onnx",
        )

    @property
    def _source(self) -> Path:
        return self.out / f"{self.name}.onnx"

    @property
    def _small(self) -> Path:
        return self.out / f"{self.name}.{self.scheme}.onnx"

    @property
    def _frames(self) -> Path:
        return self.out / "frames"

    @property
    def _held_out(self) -> Path:
        return self.out / "frames-held-out"
