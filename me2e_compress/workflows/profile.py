"""Latency of a model alone and warm, as a trace."""

import dataclasses
from pathlib import Path

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.runtime.latency_trace import LatencyTrace
from me2e_compress.runtime.others_load import BUSY, OthersLoad, is_busy
from me2e_compress.runtime.profile import WARM_UP
from me2e_compress.runtime.profile import profile as measure
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.workflows.checks import MOST_THREADS, check_count, model_path
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.first_try import try_first
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.result import Result, Table

MOST_SAMPLES = 10**9
"""Inferences that can be asked for: at a millisecond each, a fortnight."""
BEYOND_P99 = 5
"""Samples that must lie beyond the 99th percentile: with fewer, one disturbance more or
less moves it."""


@dataclasses.dataclass(frozen=True)
class ProfileOptions:
    """How latencies are measured.

    Attributes:
        samples: how many; None is one a frame.
        warm_up: inferences before the first that counts.
        threads: of onnxruntime; 0 takes all.
        provider: what runs the graph.
        force: replace outputs that are not as we left them, too.

    Raises:
        RecipeError: a number below 0, or beyond all measure.
    """

    samples: int | None = None
    warm_up: int = WARM_UP
    threads: int = 1
    provider: Provider = CPU
    force: bool = False

    def __post_init__(self) -> None:
        """Check the numbers."""
        check_count("--threads", self.threads, most=MOST_THREADS)
        check_count("--samples", self.samples or 0, most=MOST_SAMPLES)
        check_count("--warm-up", self.warm_up, most=MOST_SAMPLES)


@dataclasses.dataclass(frozen=True, repr=False)
class ProfileResult(Result):
    """Latencies of one model.

    Attributes:
        model: the file.
        trace: the samples.
        output: the trace that was written; None if none was.
        others_cores: how many cores other processes kept busy; None: not measured.
        cores: of the machine.
    """

    model: Path
    trace: LatencyTrace
    output: Path | None
    others_cores: float | None = None
    cores: int = 1

    @property
    def headline(self) -> str:
        """File, number of inferences, machine."""
        return f"{self.output or self.model.name}: {self.trace.headline}"

    def lines(self) -> tuple[str, ...]:
        """Return how far the last percentile can be trusted."""
        count, needed = len(self.trace.samples_us), 100 * BEYOND_P99
        if count >= needed:
            return ()
        return (
            f"p99 rests on too few samples: {count}, and {needed} are needed for"
            f" {BEYOND_P99} beyond it (--samples {needed})",
        )

    def alerts(self) -> tuple[str, ...]:
        """Return whether the machine was busy with something else."""
        if self.others_cores is None or not is_busy(self.others_cores, self.cores):
            return ()
        return (
            f"the machine was busy: other processes took {self.others_cores:.1f} of"
            f" {self.cores} cores, and more than {BUSY:.0%} moves latencies; measure"
            " again when it is idle",
        )

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
        """Return what the trace file holds, and how busy the machine was."""
        others = {"others_cores": self.others_cores, "cores": self.cores}
        return {**self.trace.to_json(), **others}


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
        ProviderError: the provider is not there.
    """
    options = options or ProfileOptions()
    source, written = model_path(model), None if output is None else Path(output)
    with writing([written], (source, frames), force=options.force):
        trace, load = _measured(source, Path(frames), options, listener)
        if written is not None:
            trace.save(written)
    return ProfileResult(source, trace, written, load.cores, load.of)


def _measured(
    source: Path, frames: Path, options: ProfileOptions, listener: Listener
) -> tuple[LatencyTrace, OthersLoad]:
    recording = CalibrationSet(frames)
    try_first(
        graph.load(source),
        source.name,
        listener,
        file=source,
        frames=recording,
        provider=options.provider,
    )
    with OthersLoad() as load:
        trace = measure(
            source,
            recording,
            samples=options.samples,
            warm_up=options.warm_up,
            threads=options.threads,
            provider=options.provider,
            on_sample=lambda done, total: listener.on_progress(
                "profile", done, total, "inferences"
            ),
        )
    return trace, load
