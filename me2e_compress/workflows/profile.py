"""Latency of a model alone and warm, as a trace; and its energy, if asked."""

import dataclasses
from importlib import util
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.errors import EvaluationError, MissingExtraError, RecipeError
from me2e_compress.modules import assign
from me2e_compress.runtime.breakdown import Breakdown, break_down
from me2e_compress.runtime.energy import EnergyResult
from me2e_compress.runtime.energy.counter import check_counter
from me2e_compress.runtime.energy.models import measure_energy
from me2e_compress.runtime.energy.schedule import EnergySchedule
from me2e_compress.runtime.latency_trace import (
    LatencyTrace,
    Microseconds,
    shares,
    shares_table,
)
from me2e_compress.runtime.others_load import BUSY, OthersLoad, is_busy
from me2e_compress.runtime.profile import WARM_UP
from me2e_compress.runtime.profile import profile as measure
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.workflows.checks import (
    MOST_THREADS,
    check_count,
    load_map,
    model_path,
)
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.first_try import try_first
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.result import Result, Table

MOST_SAMPLES = 10**9
"""Inferences that can be asked for: at a millisecond each, a fortnight."""
KINDS = (".png", ".svg", ".pdf")
"""Endings of a figure."""
_SHOWN = 12
"""Operators in a table."""
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
        by_module: then measure modules and operators, in inferences of their own.
        module_map: preset or TOML file; None finds the preset.
        figure: draw modules over inferences as PNG, SVG or PDF; measures them.
        force: replace outputs that are not as we left them, too.
        energy: then measure joules by ``auto`` or a counter; None does not.
        energy_output: file of these; None is beside the trace, ``.energy.json``.
        schedule: how long energy is measured, and how often; None takes the defaults.

    Raises:
        RecipeError: a number below 0, or beyond all measure; or a file of joules
            that nobody measures.
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
    energy_output: str | Path | None = None
    schedule: EnergySchedule | None = None

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.energy is None and self.energy_output is not None:
            raise RecipeError("--energy-out: there is no --energy to write")
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
        operators_us: what each operator took, in inferences under a profiler.
        figure: the picture that was drawn; None if none was.
        others_cores: how many cores other processes kept busy; None: not measured.
        cores: of the machine.
        energy: joules, or why there are none; None: not asked for.
        energy_output: the file they were written to; None if they were not.
    """

    model: Path
    trace: LatencyTrace
    output: Path | None
    others_cores: float | None = None
    cores: int = 1
    operators_us: Microseconds = dataclasses.field(default_factory=dict)
    figure: Path | None = None
    energy: EnergyResult | None = None
    energy_output: Path | None = None

    @property
    def headline(self) -> str:
        """File, number of inferences, machine."""
        return f"{self.output or self.model.name}: {self.trace.headline}"

    def lines(self) -> tuple[str, ...]:
        """Return how far the last percentile can be trusted, and the joules."""
        energy = () if self.energy is None else (self.energy.headline,)
        count, needed = len(self.trace.samples_us), 100 * BEYOND_P99
        if count >= needed:
            return energy
        return (
            *energy,
            f"p99 rests on too few samples: {count}, and {needed} are needed for"
            f" {BEYOND_P99} beyond it (--samples {needed})",
        )

    def alerts(self) -> tuple[str, ...]:
        """Return whether the machine was busy, and what puts joules in doubt."""
        energy = () if self.energy is None else self.energy.alerts()
        if self.others_cores is None or not is_busy(self.others_cores, self.cores):
            return energy
        return (
            *energy,
            f"the machine was busy: other processes took {self.others_cores:.1f} of"
            f" {self.cores} cores, and more than {BUSY:.0%} moves latencies; measure"
            " again when it is idle",
        )

    def tables(self) -> tuple[Table, ...]:
        """Return the percentiles in milliseconds, by module and operator too."""
        whole, *modules = self.trace.tables()
        energy = () if self.energy is None else self.energy.tables()
        found = (dataclasses.replace(whole, title=self.headline), *modules, *energy)
        if not self.operators_us:
            return found
        rest = len(self.operators_us) - _SHOWN
        shown = shares_table("By operator, as it runs", "operator", self.operators_us)
        note = f"{rest} more operators: --json" if rest > 0 else ""
        return *found, dataclasses.replace(shown, rows=shown.rows[:_SHOWN], note=note)

    def records(self) -> list[dict[str, object]]:
        """Return a row an inference, in their order."""
        return [{"latency_us": sample} for sample in self.trace.samples_us]

    def to_json(self) -> object:
        """Return what the trace holds, shares, joules, how busy the machine was."""
        return {
            **self.trace.to_json(),
            "modules": shares(self.trace.modules_us),
            "operators": shares(self.operators_us),
            "energy": None if self.energy is None else self.energy.to_json(),
            "others_cores": self.others_cores,
            "cores": self.cores,
        }


def profile(
    model: str | Path,
    frames: str | Path,
    output: str | Path | None = None,
    options: ProfileOptions | None = None,
    listener: Listener = SILENT,
) -> ProfileResult:
    """Measure a model alone and warm; by module and operator, and joules, if asked.

    Args:
        model: the graph, or the name of one that ships.
        frames: folder of recorded frames; repeated as often as it takes.
        output: write the latencies as a trace, which ``evaluate`` can charge.
        options: None takes the defaults.
        listener: is called with progress and warnings.

    Raises:
        GraphError: no such model, it cannot be run, or the output would harm an input.
        EvaluationError: there is nothing to measure, or no such kind of picture.
        EnergyError: no such counter, or it goes back, stands still or cannot be read;
            that there is none is a result.
        FramesError: a frame does not fit.
        ModuleMapError: no such map.
        ProviderError: the provider is not there.
    """
    options = options or ProfileOptions()
    source, written = model_path(model), None if output is None else Path(output)
    figure = None if options.figure is None else figure_path(options.figure)
    joules = _energy_path(options, written)
    if options.energy is not None:
        check_counter(options.energy)
    inputs = (source, frames, options.module_map)
    with writing([written, figure, joules], inputs, force=options.force):
        loaded, recording = graph.load(source), CalibrationSet(Path(frames))
        trace, load = _measured(source, loaded, recording, options, listener)
        operators: Microseconds = {}
        if options.by_module or figure is not None:
            found = _broken_down(loaded, recording, options, listener)
            trace = dataclasses.replace(trace, modules_us=found.modules_us)
            operators = found.operators_us
        energy = _energy(source, recording, options, listener)
        if figure is not None:
            draw(trace, source.stem, figure)
        if written is not None:
            trace.save(written)
        if energy is not None and joules is not None:
            energy.save(joules)
    return ProfileResult(
        *(source, trace, written, load.cores, load.of, operators, figure),
        energy=energy,
        energy_output=joules,
    )


def _energy_path(options: ProfileOptions, trace: Path | None) -> Path | None:
    """Return the file of the joules: as named, or beside the trace."""
    if options.energy_output is not None:
        return Path(options.energy_output)
    if options.energy is None or trace is None:
        return None
    return trace.with_suffix(".energy.json")


def _energy(
    source: Path,
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
        on_window=lambda done, total, name: listener.on_progress(
            "energy", done, total, "windows"
        ),
    )
    return found[source.name]


def figure_path(named: str | Path) -> Path:
    """Return the file of a figure, if it can be drawn.

    Raises:
        EvaluationError: its name does not end as one of :data:`KINDS` of pictures.
        MissingExtraError: matplotlib is not installed.
    """
    path = Path(named)
    if path.suffix not in KINDS:
        raise EvaluationError(f"{path}: a figure ends in {', '.join(KINDS)}")
    if util.find_spec("matplotlib") is None:
        raise MissingExtraError("matplotlib", "highway")
    return path


def draw(trace: LatencyTrace, name: str, path: Path) -> None:
    """Draw what modules took, inference by inference; see :mod:`latency_figure`."""
    from me2e_compress.workflows.latency_figure import draw_modules  # matplotlib

    draw_modules(trace.modules_us, name, trace.machine, path)


def _broken_down(
    loaded: ir.Model,
    recording: CalibrationSet,
    options: ProfileOptions,
    listener: Listener,
) -> Breakdown:
    """Measure modules and operators in as many inferences, under the profiler."""
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
    loaded: ir.Model,
    recording: CalibrationSet,
    options: ProfileOptions,
    listener: Listener,
) -> tuple[LatencyTrace, OthersLoad]:
    try_first(
        loaded,
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
