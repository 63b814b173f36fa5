"""Steps of all demos; the demo with a stack of published size, which does not drive."""

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.manager import recipe
from me2e_compress.runtime.interleaved import RunTimes, time_interleaved
from me2e_compress.runtime.providers import CPU, PROVIDERS, Provider
from me2e_compress.runtime.session import Session
from me2e_compress.workflows.checks import check_folder
from me2e_compress.workflows.compare import CompareResult, compare
from me2e_compress.workflows.compress import CompressOptions, compress
from me2e_compress.workflows.compress_result import CompressResult
from me2e_compress.workflows.export import ExportOptions, export_stack
from me2e_compress.workflows.frames import FramesOptions, record_frames
from me2e_compress.workflows.listener import Listener
from me2e_compress.workflows.module_changes import ModuleChanges, compare_modules
from me2e_compress.workflows.result import Result, Table, megabytes, table

CALIBRATION_FRAMES, HELD_OUT_FRAMES = 8, 4
SCENE_LENGTH = 4
ROUNDS, THREADS = 4, 2
"""How latencies are measured: rounds of all files, and threads of onnxruntime."""


@dataclasses.dataclass(frozen=True, repr=False)
class FilesResult(Result):
    """Size and latency of files, measured in turn on one frame.

    Attributes:
        times: times by file; the first file is what the others are compared with.
        ending: what the user has now, in words.
        plan: how far the plan moved, in words.
    """

    times: dict[Path, RunTimes]
    threads: int
    rounds: int
    ending: str
    plan: str
    provider: Provider = CPU

    @property
    def headline(self) -> str:
        """What a frame takes, against the stack as it was exported."""
        first, *_, last = (each.median_wall_s for each in self.times.values())
        return f"{last:.2f} s a frame, {last / first:.2f} of {first:.2f}"

    def lines(self) -> tuple[str, ...]:
        """Return the last file's size and time, the plan, and what is not measured."""
        (source, before), *_, (path, after) = self.times.items()
        sizes = graph.file_bytes(path), graph.file_bytes(source)
        ratio = after.median_wall_s / before.median_wall_s
        return (
            f"{megabytes(sizes[0])} MB, {sizes[0] / sizes[1]:.0%} of"
            f" {megabytes(sizes[1])}; {after.median_wall_s:.2f} s a frame, {ratio:.2f}"
            f" of {before.median_wall_s:.2f}",
            self.plan,
            "nothing drives here: what that means on the road is not measured",
            self.ending,
        )

    def tables(self) -> tuple[Table, ...]:
        """Return one row per file."""
        first = next(iter(self.times.values()))
        # ratios are of medians, which resist disturbances better than means
        rows = [
            (
                path.name,
                megabytes(graph.file_bytes(path)),
                f"{each.median_wall_s:.3f}",
                f"{each.best_wall_s:.3f}",
                f"{min(each.cpu_s):.3f}",
                f"{each.median_wall_s / first.median_wall_s:.3f}",
            )
            for path, each in self.times.items()
        ]
        how = f"{self.threads} threads, {self.rounds} rounds in turn"
        on = "this CPU" if self.provider == CPU else PROVIDERS.text(self.provider)
        return (
            table(
                f"Files, and latency on {on} ({how})",
                ("file", "MB", "median s", "best s", "CPU s", "ratio to the first"),
                rows,
            ),
        )

    def records(self) -> list[dict[str, object]]:
        """Return one row per file."""
        return [
            {
                "file": path.name,
                "bytes": graph.file_bytes(path),
                "median_wall_s": each.median_wall_s,
                "best_wall_s": each.best_wall_s,
                "cpu_s": min(each.cpu_s),
            }
            for path, each in self.times.items()
        ]

    def to_json(self) -> object:
        """Return one row per file."""
        return {"files": self.records()}


@dataclasses.dataclass(frozen=True)
class Demo:
    """Steps of a demo: make a model small, weigh it and compare it with its source.

    Attributes:
        name: a stack or driver of the zoo.
        out: the folder that everything is written to.
        recipe_name: a shipped recipe, or a TOML file.
        provider: what runs the graphs.
        force: replace files that we did not write, too.

    Raises:
        RecipeError: There is no such recipe.
        GraphError: The output folder is a file.
    """

    name: str
    out: Path
    recipe_name: str = "full-fused"
    provider: Provider = CPU
    force: bool = False

    def __post_init__(self) -> None:
        """Check recipe and folder first: the work takes minutes."""
        recipe.load(self.recipe_name)
        check_folder(self.out, ())

    @property
    def steps(self) -> dict[str, Callable[[Listener], Result]]:
        """The steps by name, in order, once the model is compressed."""
        return {"weigh": self.weigh, "compare": self.compare}

    def weigh(self, listener: Listener) -> ModuleChanges:
        """Weigh the modules before and after."""
        return compare_modules(self._source, self._small)

    def compare(self, listener: Listener) -> CompareResult:
        """Compare the small graph with its source on the held-out frames."""
        graphs = self._source, self._small
        return compare(*graphs, self._held_out, listener, provider=self.provider)

    def _compressed(
        self, listener: Listener, *, allow_empty: bool = False
    ) -> CompressResult:
        """Compress on the recorded frames, int8 in the form that the provider runs."""
        passes = recipe.load(self.recipe_name)
        quantizes = any(each.quantizes for each in passes)
        # fidelity is measured on frames of another seed, see `compare`
        options = CompressOptions(
            target=self.provider.target if quantizes else None, measure_frames=0,
            allow_empty=allow_empty, provider=self.provider, force=self.force,
        )  # fmt: skip
        return compress(
            self._source, self._small, passes, self._frames, options, listener
        )

    def _record(
        self,
        source: str | Path,
        counts: tuple[int, int],
        listener: Listener,
        scene_length: int | None = None,
    ) -> None:
        """Record frames to calibrate on, and others to compare on, of the next seed."""
        folders = self._frames, self._held_out
        for seed, (folder, count) in enumerate(zip(folders, counts, strict=True)):
            asked = count, seed, scene_length, self.force, self.provider
            record_frames(source, folder, FramesOptions(*asked), listener)

    @property
    def _source(self) -> Path:
        return self.out / f"{self.name}.onnx"

    @property
    def _small(self) -> Path:
        return self.out / f"{self.name}.{self.recipe_name}.onnx"

    @property
    def _frames(self) -> Path:
        return self.out / "frames"

    @property
    def _held_out(self) -> Path:
        return self.out / "frames-held-out"


@dataclasses.dataclass(frozen=True)
class StackDemo(Demo):
    """A stack of the zoo, ``vad-tiny``, to export, compress, compare and time."""

    _compared: list[CompareResult] = dataclasses.field(default_factory=list, init=False)

    @property
    def steps(self) -> dict[str, Callable[[Listener], Result]]:
        """The steps by name, in order."""
        return {"compress": self.compress, **super().steps, "time": self.time}

    def compress(self, listener: Listener) -> CompressResult:
        """Export the stack, write its frames and compress it."""
        export_stack(self.name, self._source, ExportOptions(force=self.force))
        counts = CALIBRATION_FRAMES, HELD_OUT_FRAMES
        self._record(self.name, counts, listener, SCENE_LENGTH)
        return self._compressed(listener)

    def compare(self, listener: Listener) -> CompareResult:
        """Compare the small graph with the stack on the held-out frames."""
        self._compared.append(super().compare(listener))
        return self._compared[-1]

    def time(self, listener: Listener) -> FilesResult:
        """Time the stack, its exact form and the small graph in turn."""
        # the exact form shows how much of the gain is not int8's
        exact = self.out / f"{self.name}.exact.onnx"
        unchecked = CompressOptions(
            verify_frames=0, provider=self.provider, force=self.force
        )
        compress(self._source, exact, "exact", options=unchecked, listener=listener)
        paths = {path.name: path for path in (self._source, exact, self._small)}
        # all files run in turn on one frame, so that noise meets each alike
        sessions = {
            name: Session(
                path,
                threads=THREADS,
                int8_kernels=True,
                release=True,
                provider=self.provider,
            )
            for name, path in paths.items()
        }
        frame = CalibrationSet(self._held_out)[0]
        progress = partial(listener.on_progress, "latency")
        times = time_interleaved(sessions, [frame], ROUNDS, progress)
        report = self._small.with_name(self._small.stem + ".report.json")
        return FilesResult(
            {paths[name]: each for name, each in times.items()},
            THREADS,
            ROUNDS,
            f"{self._small} and {report} are yours.",
            self._compared[-1].headline if self._compared else "plan: not measured",
            self.provider,
        )
