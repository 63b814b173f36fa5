"""Latencies of a model, and its energy: measured alone and warm, or imported."""

import dataclasses
from pathlib import Path

from me2e_compress import graph
from me2e_compress.base import atomic
from me2e_compress.base.errors import EvaluationError
from me2e_compress.base.listener import SILENT, Listener
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.commands.checks import load_map, model_path, opened, writing
from me2e_compress.commands.options import ProfileOptions, check_number
from me2e_compress.commands.result import Result, View
from me2e_compress.graph.modules.assign import assign
from me2e_compress.metrics import BUDGET_MS
from me2e_compress.metrics.deadlines import Deadlines, deadlines, deadlines_table
from me2e_compress.runtime.breakdown import break_down
from me2e_compress.runtime.energy import EnergyResult
from me2e_compress.runtime.energy.energy_counter import check_counter
from me2e_compress.runtime.energy.meter import measure_energy
from me2e_compress.runtime.latency_trace import (
    LatencyTrace,
    Microseconds,
    OthersLoad,
    read_latencies,
    shares_table,
    time_shares,
)
from me2e_compress.runtime.profile import WARM_UP
from me2e_compress.runtime.profile import profile as measure
from me2e_compress.targets.onnxruntime.convert import slow_here

_SHOWN = 12


@dataclasses.dataclass(frozen=True, repr=False)
class ProfileResult(Result):
    """Latencies of one model."""

    model: Path
    trace: LatencyTrace
    output: Path | None
    # microseconds of each operator, in inferences under a profiler
    operators_us: Microseconds = dataclasses.field(default_factory=dict)
    # joules, or why there are none; None if not asked for
    energy: EnergyResult | None = None
    energy_output: Path | None = None
    budget_ms: float = BUDGET_MS
    # why the file is slow on this CPU, whose form is not its own
    slow_here: str | None = None
    known: str = ""  # which inputs are state, and from where that is known

    @property
    def deadlines(self) -> Deadlines:
        """The samples compared with the budget."""
        return deadlines(self.trace.samples_us, self.budget_ms)

    def view(self) -> View:
        """Return percentiles, then modules, energy and operators, and doubts."""
        headline = f"{self.output or self.model.name}: {self.trace.headline}"
        whole, *modules = self.trace.tables()
        energy, load = self.energy, self.trace.others
        tables = [
            dataclasses.replace(whole, title=headline),
            deadlines_table("Against the budget", self.deadlines),
            *modules,
            *(() if energy is None else energy.tables()),
        ]
        # Of many operators the first are shown, with a note on the others
        if self.operators_us:
            rest = len(self.operators_us) - _SHOWN
            title = "By operator, as it runs"
            every = shares_table(title, "operator", self.operators_us)
            more = f"{rest} more operators: --json" if rest > 0 else ""
            note = "; ".join(filter(None, (every.note, more)))
            rows = every.rows[:_SHOWN]
            tables.append(dataclasses.replace(every, rows=rows, note=note))
        # Joules, and what puts joules and times in doubt
        joules = "" if energy is None else energy.headline
        lines = [*filter(None, [self.known, joules])]
        busy = str(load) if load is not None and load.busy else None
        slow = self.slow_here and f"{self.model.name}: {self.slow_here}"
        doubts = () if energy is None else energy.alerts()
        return View(headline, tables, lines, (*doubts, *filter(None, (busy, slow))))

    def to_json(self) -> object:
        """Return the trace, deadlines, shares, joules, and how busy the machine was."""
        load = self.trace.others
        nobody = {"others_cores": None, "cores": None}
        return {
            **self.trace.to_json(),
            "deadlines": self.deadlines,
            "modules": time_shares(self.trace.modules_us),
            "operators": time_shares(self.operators_us),
            "energy": self.energy,
            "slow_here": self.slow_here,
            "known": self.known,
            **(nobody if load is None else load.to_json()),
        }


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
        EvaluationError: There is nothing to measure.
        EnergyError: The named counter does not exist or work; if there is none at all,
            that is a result.
        FramesError: A frame does not fit.
        ModuleMapError: The map does not exist.
        ProviderError: The provider is not available.
    """
    # Joules lie beside the trace
    options = options or ProfileOptions()
    source, written = model_path(model), None if output is None else Path(output)
    joules = None
    if options.energy is not None:
        check_counter(options.energy)
        joules = None if written is None else written.with_suffix(".energy.json")
    inputs = (source, frames, options.module_map, options.adapter)
    with writing([written, joules], inputs, force=options.force):
        # each measurement has inferences of its own: the profiler takes time itself
        recording, threads = CalibrationSet(Path(frames)), options.threads
        opening = opened(source, recording, options, listener)
        loaded, metadata = opening.model, opening.metadata
        provider = options.runs_on
        with OthersLoad() as others:
            trace = measure(
                source, recording, samples=options.samples, threads=threads,
                provider=provider, metadata=metadata,
                on_sample=listener.counting("profile", "inferences"),
            )  # fmt: skip
        trace = dataclasses.replace(trace, others=others.load)
        # By module and operator, under a profiler
        operators: Microseconds = {}
        if options.by_module:
            placed = assign(loaded, load_map(options.module_map, loaded))
            parts = break_down(
                loaded, placed.module_of, recording, warm_up=WARM_UP,
                runs=options.samples or len(recording), threads=threads,
                provider=provider, on_run=listener.counting("by module", "inferences"),
            )  # fmt: skip
            trace = dataclasses.replace(trace, modules_us=parts.modules_us)
            operators = parts.operators_us
        # Joules, over windows of many inferences
        energy, windows = None, listener.counting("energy", "windows")
        if options.energy is not None:
            energy = measure_energy(
                {source.name: source}, recording, options.energy, threads=threads,
                provider=provider, metadata=metadata,
                on_window=lambda done, total, name: windows(done, total),
            )[source.name]  # fmt: skip
        # files are written all or none
        with atomic.all_or_none():
            if written is not None:
                trace.save(written)
            if energy is not None and joules is not None:
                energy.save(joules)
    return ProfileResult(
        source,
        trace,
        written,
        operators,
        energy=energy,
        energy_output=joules,
        budget_ms=options.budget_ms,
        slow_here=slow_here(loaded, provider),
        known=opening.known,
    )


def import_profile(
    model: str | Path,
    file: str | Path,
    output: str | Path | None = None,
    *,
    budget_ms: float = BUDGET_MS,
    force: bool = False,
) -> ProfileResult:
    """Read what another tool measured; nothing is run.

    `file` holds times or a profile of trtexec, or a trace. `output` is a trace of this
    very model file, which ``evaluate`` can charge.

    Raises:
        GraphError: The model does not exist, or the output would harm an input.
        EvaluationError: The file is missing or malformed.
        RecipeError: The budget is not positive.
    """
    check_number("--budget-ms", budget_ms)
    source, written = model_path(model), None if output is None else Path(output)
    with writing([written], (source, file), force=force):
        imported = read_latencies(Path(file))
        # the trace belongs to the very file that was measured
        trace = LatencyTrace(
            graph.sha256_of(source), imported.machine, imported.samples_us
        )
        if written is not None:
            trace.save(written)
    return ProfileResult(
        source, trace, written, operators_us=imported.layers_us, budget_ms=budget_ms
    )


def check_import(frames: Path | None, options: ProfileOptions) -> None:
    """Refuse options that measure where latencies are imported."""
    asked = {
        "FRAMES": frames,
        "--samples": options.samples,
        "--by-module": options.by_module,
        "--energy": options.energy,
        "--adapter": options.adapter,
    }
    for name, value in asked.items():
        if value not in (None, False):
            raise EvaluationError(f"--import runs nothing: leave {name} out")
