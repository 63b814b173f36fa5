"""Measure the latency of a model alone and warm, and its energy, if asked."""

import dataclasses
from collections.abc import Mapping
from importlib import util
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.driving.adapter.outputs import adapted
from me2e_compress.errors import EvaluationError, MissingExtraError
from me2e_compress.graph.modules import assign
from me2e_compress.metrics.deadlines import BUDGET_MS
from me2e_compress.registry import drafts
from me2e_compress.runtime.breakdown import Breakdown, break_down
from me2e_compress.runtime.energy import EnergyResult
from me2e_compress.runtime.energy.energy_counter import EnergySchedule, check_counter
from me2e_compress.runtime.energy.meter import measure_energy
from me2e_compress.runtime.latency_trace import LatencyTrace, Microseconds, OthersLoad
from me2e_compress.runtime.profile import WARM_UP
from me2e_compress.runtime.profile import profile as measure
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.targets.onnxruntime import slow_here
from me2e_compress.workflows.checks import (
    MOST_THREADS,
    check_count,
    load_map,
    model_path,
)
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.deadlines_table import check_budget
from me2e_compress.workflows.first_opening import try_first
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.profile_result import ProfileResult

MOST_SAMPLES = 10**9
"""Most inferences that can be asked for: at a millisecond each, a fortnight."""
KINDS = (".png", ".svg", ".pdf")
"""File name endings of a figure."""


@dataclasses.dataclass(frozen=True)
class ProfileOptions:
    """How latencies are measured.

    Attributes:
        samples: number of samples; None is one per frame.
        warm_up: inferences before the first that counts.
        threads: threads of onnxruntime; 0 takes all.
        provider: what runs the graph.
        by_module: also measure modules and operators, in inferences of their own.
        module_map: preset or TOML file; None finds the preset.
        figure: draw modules over inferences as PNG, SVG or PDF; measures them.
        force: replace outputs that we did not write, too.
        energy: also measure joules by ``auto`` or a named counter; None does not.
        schedule: how long energy is measured, and how often; None takes the defaults.
        budget_ms: milliseconds that a decision may take.
        adapter: TOML file that says which outputs are fed back.
    """

    samples: int | None = None
    warm_up: int = WARM_UP
    threads: int = 1
    provider: Provider = CPU
    by_module: bool = False
    module_map: str | Path | None = None
    figure: str | Path | None = None
    force: bool = False
    energy: str | None = None
    schedule: EnergySchedule | None = None
    budget_ms: float = BUDGET_MS
    adapter: str | Path | None = None

    def __post_init__(self) -> None:
        check_budget(self.budget_ms)
        check_count("--threads", self.threads, most=MOST_THREADS)
        check_count("--samples", self.samples or 0, most=MOST_SAMPLES)
        check_count("--warm-up", self.warm_up, most=MOST_SAMPLES)


def profile(
    model: str | Path,
    frames: str | Path,
    output: str | Path | None = None,
    options: ProfileOptions | None = None,
    listener: Listener = SILENT,
) -> ProfileResult:
    """Measure a model alone and warm; by module and operator, and joules, if asked.

    The model is an ONNX file or the name of one that ships; frames are repeated as
    often as needed. `output` is a trace, which ``evaluate`` can charge.

    Raises:
        GraphError: The model does not exist or run, or the output would harm an input.
        EvaluationError: There is nothing to measure, or a figure of another kind.
        EnergyError: The named counter does not exist or work; if there is none at all,
            that is a result.
        FramesError: A frame does not fit.
        ModuleMapError: The map does not exist.
        ProviderError: The provider is not available.
    """
    options = options or ProfileOptions()
    source, written = model_path(model), None if output is None else Path(output)
    figure = None if options.figure is None else _figure_path(options.figure)
    joules = _energy_path(options, written)
    # refuse what cannot be measured before anything is
    if options.energy is not None:
        check_counter(options.energy)
    inputs = (source, frames, options.module_map, options.adapter)
    with writing([written, figure, joules], inputs, force=options.force):
        # each measurement has inferences of its own: the profiler takes time itself
        recording = CalibrationSet(Path(frames))
        loaded = graph.load(source)
        said = adapted(loaded, options.adapter, options.module_map)
        try_first(
            loaded, source.name, recording, listener=listener, file=source,
            provider=options.provider,
        )  # fmt: skip
        trace = _measured(source, said, recording, options, listener)
        operators: Microseconds = {}
        if options.by_module or figure is not None:
            recording.check(loaded)
            found = _broken_down(loaded, recording, options, listener)
            trace = dataclasses.replace(trace, modules_us=found.modules_us)
            operators = found.operators_us
        energy = _energy(source, said, recording, options, listener)
        # files are written all or none
        with drafts.all_or_none():
            if figure is not None:
                from me2e_compress.workflows.latency_figure import (  # matplotlib
                    draw_modules,
                )

                draw_modules(trace, source.stem, figure)
            if written is not None:
                trace.save(written)
            if energy is not None and joules is not None:
                energy.save(joules)
    return ProfileResult(
        *(source, trace, written, operators, figure),
        energy=energy,
        energy_output=joules,
        budget_ms=options.budget_ms,
        slow_here=slow_here(loaded, options.provider),
    )


def _energy_path(options: ProfileOptions, trace: Path | None) -> Path | None:
    if options.energy is None or trace is None:
        return None
    return trace.with_suffix(".energy.json")


def _energy(
    source: Path,
    said: Mapping[str, str],
    recording: CalibrationSet,
    options: ProfileOptions,
    listener: Listener,
) -> EnergyResult | None:
    if options.energy is None:
        return None
    found = measure_energy(
        {source.name: source},
        recording,
        options.energy,
        options.schedule,
        threads=options.threads,
        provider=options.provider,
        said=said,
        on_window=lambda done, total, name: listener.on_progress(
            "energy", done, total, "windows"
        ),
    )
    return found[source.name]


def _figure_path(named: str | Path) -> Path:
    """Return the file of a figure, if its kind is known and matplotlib is installed."""
    path = Path(named)
    if path.suffix not in KINDS:
        raise EvaluationError(f"{path}: a figure ends in {', '.join(KINDS)}")
    if util.find_spec("matplotlib") is None:
        raise MissingExtraError("matplotlib", "highway")
    return path


def _broken_down(
    loaded: ir.Model,
    recording: CalibrationSet,
    options: ProfileOptions,
    listener: Listener,
) -> Breakdown:
    placed = assign(loaded, load_map(options.module_map, loaded))
    return break_down(
        loaded,
        placed.module_of,
        recording,
        runs=len(recording) if options.samples is None else options.samples,
        warm_up=options.warm_up,
        threads=options.threads,
        provider=options.provider,
        on_run=lambda done, total: listener.on_progress(
            "by module", done, total, "inferences"
        ),
    )


def _measured(
    source: Path,
    said: Mapping[str, str],
    recording: CalibrationSet,
    options: ProfileOptions,
    listener: Listener,
) -> LatencyTrace:
    with OthersLoad() as others:
        trace = measure(
            source,
            recording,
            samples=options.samples,
            warm_up=options.warm_up,
            threads=options.threads,
            provider=options.provider,
            said=said,
            on_sample=lambda done, total: listener.on_progress(
                "profile", done, total, "inferences"
            ),
        )
    return dataclasses.replace(trace, others=others.load)
