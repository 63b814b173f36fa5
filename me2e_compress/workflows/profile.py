"""Latency of a model alone and warm, as a trace."""

import dataclasses
from pathlib import Path

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.runtime.latency_trace import LatencyTrace
from me2e_compress.runtime.profile import WARM_UP
from me2e_compress.runtime.profile import profile as measure
from me2e_compress.workflows.checks import check_count, model_path
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.first_try import try_first
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.result import Result, Table


@dataclasses.dataclass(frozen=True)
class ProfileOptions:
    """How latencies are measured.

    Attributes:
        samples: how many; None is one a frame.
        warm_up: inferences before the first that counts.
        threads: of onnxruntime; 0 takes all.
        force: replace outputs that are not as we left them, too.

    Raises:
        RecipeError: threads below 0.
    """

    samples: int | None = None
    warm_up: int = WARM_UP
    threads: int = 1
    force: bool = False

    def __post_init__(self) -> None:
        """Check the number of threads."""
        check_count("--threads", self.threads)


@dataclasses.dataclass(frozen=True, repr=False)
class ProfileResult(Result):
    """Latencies of one model.

    Attributes:
        model: the file.
        trace: the samples.
        output: the trace that was written; None if none was.
    """

    model: Path
    trace: LatencyTrace
    output: Path | None

    @property
    def headline(self) -> str:
        """File, number of inferences, machine."""
        return f"{self.output or self.model.name}: {self.trace.headline}"

    def lines(self) -> tuple[str, ...]:
        """Return none: the table's title is the headline."""
        return ()

    def tables(self) -> tuple[Table, ...]:
        """Return the percentiles in milliseconds."""
        return tuple(
            dataclasses.replace(each, title=self.headline)
            for each in self.trace.tables()
        )

    def records(self) -> list[dict[str, object]]:
        """Return a row an inference, in their order."""
        return [{"latency_us": sample} for sample in self.trace.samples_us]

    def to_json(self) -> object:
        """Return what the trace file holds."""
        return self.trace.to_json()


def profile(
    model: str | Path,
    frames: str | Path,
    output: str | Path | None = None,
    options: ProfileOptions | None = None,
    listener: Listener = SILENT,
) -> ProfileResult:
    """Measure a model alone and warm.

    Args:
        model: the graph, or the name of one that ships.
        frames: folder of recorded frames; repeated as often as it takes.
        output: write the latencies as a trace, which ``evaluate`` can charge.
        options: None takes the defaults.
        listener: is called with progress and warnings.

    Raises:
        GraphError: no such model, it cannot be run, or the output would harm an input.
        EvaluationError: there is nothing to measure.
        FramesError: a frame does not fit.
    """
    options = options or ProfileOptions()
    source, written = model_path(model), None if output is None else Path(output)
    with writing([written], (source, frames), force=options.force):
        trace = _measured(source, Path(frames), options, listener)
        if written is not None:
            trace.save(written)
    return ProfileResult(source, trace, written)


def _measured(
    source: Path, frames: Path, options: ProfileOptions, listener: Listener
) -> LatencyTrace:
    recording = CalibrationSet(frames)
    try_first(graph.load(source), source.name, listener, file=source, frames=recording)
    return measure(
        source,
        recording,
        samples=options.samples,
        warm_up=options.warm_up,
        threads=options.threads,
        on_sample=lambda done, total: listener.on_progress(
            "profile", done, total, "inferences"
        ),
    )
