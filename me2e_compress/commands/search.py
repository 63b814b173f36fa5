"""Int8 by trials: what each module costs, and what meets budgets at least loss."""

import dataclasses
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from timeit import repeat

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.display import format_mb, format_significant, plural, table
from me2e_compress.base.errors import EnergyError, RecipeError
from me2e_compress.base.listener import SILENT, Listener
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet, draw
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.commands.checks import (
    load_map,
    model_path,
    opened,
    output_path,
    writing,
)
from me2e_compress.commands.options import (
    SearchOptions,
    SensitivityOptions,
    TrialOptions,
)
from me2e_compress.commands.plan import PreparedGraph
from me2e_compress.commands.result import Result, View
from me2e_compress.fidelity.sensitivity import (
    Budget,
    Candidate,
    Int8Choice,
    Score,
    Sensitivity,
    Trials,
    advise,
    analyse,
    write_recipe,
)
from me2e_compress.fidelity.sensitivity import search as find
from me2e_compress.manager import recipe
from me2e_compress.quantization.decision import QuantScheme
from me2e_compress.quantization.rules import DEFAULT_RULES, RULE_SETS
from me2e_compress.runtime.energy.energy_counter import EnergySchedule, open_counter
from me2e_compress.runtime.energy.energy_result import FEWEST_WINDOWS, Absent, Reader
from me2e_compress.runtime.energy.meter import measure_energy
from me2e_compress.runtime.session import Session, replay
from me2e_compress.targets import DEFAULT_TARGET, TARGETS


@dataclasses.dataclass(frozen=True)
class TrialFiles:
    """Where trials read and write: float model, folder of frames, and the recipe."""

    model: Path
    frames: Path
    output: Path

    def claim_outputs(self, options: TrialOptions) -> AbstractContextManager[None]:
        """Check the recipe and its overrides as outputs; see :func:`writing`."""
        output = output_path(self.output)
        named = (options.ranges, options.module_map, options.adapter)
        read = (self.model, self.frames, *named)
        overrides = output.with_name(output.stem + ".overrides.toml")
        return writing([output, overrides], read, force=options.force)

    def prepare(
        self, options: TrialOptions, listener: Listener
    ) -> tuple[Trials, tuple[str, ...]]:
        """Prepare the graph, calibrate once, and name the modules to try."""
        # check names and frames before anything is run
        rules = RULE_SETS.parse(options.rules or DEFAULT_RULES)
        place = TARGETS.parse(options.target or DEFAULT_TARGET)
        recording = CalibrationSet(self.frames)
        # Modules of the scheme
        loaded = opened(self.model, recording, options, listener).model
        modules = load_map(options.module_map, loaded)
        scheme = QuantScheme.named(options.scheme or "full", modules)
        # The graph is prepared once; every trial starts from there
        ready = PreparedGraph.of(self.model, loaded, options.module_map)
        model, tensors, provider = ready.model, ready.tensors(), options.runs_on
        if options.ranges is not None:
            ranges, name = Ranges.load(Path(options.ranges)), options.ranges
            digest, method = graph.digest(model), ranges.method
            ranges.check(model=digest, tensors=tensors, method=method, named=name)
        else:
            listening = listener.counting("calibrate")
            calibrator = Calibrator(rules.method, provider=provider)
            ranges = calibrator.run(model, tensors, recording, listening)
        return Trials(
            model,
            ready.modules,
            rules,
            place,
            ranges,
            draw(recording, options.count, 0),
            provider=provider,
        ), scheme.modules

    def write(self, choice: Int8Choice, options: TrialOptions) -> str:
        """Write the recipe, and return a line that says what it makes int8."""
        # The exact passes, then int8 of the choice
        before = [step.name for step in recipe.load("exact")]
        rules = options.rules or DEFAULT_RULES
        target = options.target or DEFAULT_TARGET
        overrides = write_recipe(self.output, choice, before, rules, target)
        listed = ", ".join(choice.modules) or "no module"
        more = f", {len(choice.floats)} of their nodes in float" if overrides else ""
        return f"{self.output}: int8 in {listed}{more}"


@dataclasses.dataclass(frozen=True, repr=False)
class SearchResult(Result):
    """What was tried, and the recipe; the last assignment fits and is the recipe's."""

    output: Path
    tried: tuple[Candidate, ...]
    limits: tuple[tuple[str, float], ...]
    written: str

    def view(self) -> View:
        """Return the recipe, and what was tried, best first."""
        rows = [
            (
                ", ".join(one.modules) or "none",
                format_significant(None if one.score is None else one.score.loss),
                format_significant(one.loss),
                *map(format_significant, one.measured_costs or ()),
            )
            for one in self.tried
        ]
        limits = " and ".join(
            f"{format_significant(limit, 6)} {unit}" for unit, limit in self.limits
        )
        columns = ("int8", "loss", "predicted", *(unit for unit, _ in self.limits))
        tried = table("Tried, best first", columns, rows, f"budget: {limits}")
        return View(self.written, [tried])

    def to_json(self) -> object:
        """Return the budgets, and what was tried."""
        budgets = [{"unit": unit, "limit": limit} for unit, limit in self.limits]
        return {"budgets": budgets, "tried": self.tried}


def search(
    model: str | Path,
    frames: str | Path,
    output: str | Path,
    options: SearchOptions,
    listener: Listener = SILENT,
) -> SearchResult:
    """Find the modules whose int8 meets the budgets and costs the plan least.

    The model is a float ONNX file or the name of one that ships; the output is a
    recipe.

    Raises:
        GraphError: The model does not exist, or the output would harm an input.
        RecipeError: There is no such scheme, rule set or target.
        EnergyError: No counter answers, or one is not usable.
        FramesError: Frames or saved ranges do not fit.
        PreconditionError: The graph is quantized already, or nothing can become int8.
        EvaluationError: Nothing fits; the message says what the least was.
    """
    if options.max_ms is not None and options.target not in (None, DEFAULT_TARGET):
        raise RecipeError(
            f"--max-ms is measured on this CPU, where int8 for {options.target} is"
            f" slow: use --target {DEFAULT_TARGET}"
        )
    # Nothing is measured before outputs and counter are known to be usable
    files = TrialFiles(model_path(model), Path(frames), Path(output))
    with files.claim_outputs(options):
        # Without a counter there are no joules
        if options.max_joules is not None:
            counter = open_counter()
            if isinstance(counter, Absent):
                raise EnergyError(f"--max-joules: {counter.reason}")
            if isinstance(counter, Reader):
                counter.close()
        # calibrate once, then search variants of that one graph
        trials, modules = files.prepare(options, listener)
        # sizes and seconds in base units, as they are measured
        mb, ms, most_j = options.max_mb, options.max_ms, options.max_joules
        asked = (
            (mb and mb * 1e6, "bytes of weights", lambda m: graph.size(m).weight_bytes),
            (ms and ms / 1e3, "s", partial(_measure_seconds, trials)),
            (most_j, "J", partial(_measure_joules, trials)),
        )
        budgets = [Budget(m, unit, of) for m, unit, of in asked if m is not None]
        report = partial(listener.on_progress, "modules")
        tried = find(trials, modules, budgets, progress=report)
        written = files.write(Int8Choice(tried[-1].modules), options)
    limits = tuple((budget.unit, budget.limit) for budget in budgets)
    return SearchResult(files.output, tried, limits, written)


def _measure_joules(trials: Trials, model: ir.Model) -> float:
    """Return joules per frame over the fewest windows that give an interval."""
    provider, frames = trials.reference.session.provider, trials.reference.frames
    schedule = EnergySchedule(windows=FEWEST_WINDOWS)
    # energy is measured of a file
    with TemporaryDirectory() as folder:
        file = Path(folder) / "int8.onnx"
        graph.save(model, file)
        energy = measure_energy(
            {"model": file}, frames, schedule=schedule, threads=0, provider=provider
        )["model"]
    if energy.j_per_frame is None:
        raise EnergyError(f"{file}: its joules are not known: {energy.reason}")
    return energy.j_per_frame


def _measure_seconds(trials: Trials, model: ir.Model) -> float:
    """Return the least wall time of a frame in 5 runs."""
    provider = trials.reference.session.provider
    session = Session(model, int8_kernels=True, release=True, provider=provider)
    first = next(iter(trials.reference.frames))
    times = repeat(lambda: list(replay(session, [first])), number=1, repeat=6)
    return min(times[1:])  # the first warms up


@dataclasses.dataclass(frozen=True, repr=False)
class SensitivityResult(Result):
    """What int8 costs, and the recipe."""

    keys = ("*sensitivity",)
    output: Path
    sensitivity: Sensitivity
    choice: Int8Choice
    score: Score | None  # loss of the choice; None where nothing is int8
    limit: float
    written: str

    def view(self) -> View:
        """Return what int8 costs by module, the nodes to blame, recipe and its loss."""
        sensitivity, unit = self.sensitivity, self.sensitivity.together.unit
        # A row a module, then the nodes to blame and the recipe
        rows = [
            (module.module, str(module.nodes), *_cells(module.score))
            for module in sensitivity.findings
        ]
        rows.append(("together", "", *_cells(sensitivity.together)))
        columns = ("module", "nodes", f"loss {unit}", "worst output, dB")
        size = format_mb(sensitivity.together.weight_bytes)
        note = f"{plural(sensitivity.trials, 'variant')} run; all together {size} MB"
        lines = [
            f"{module.module}: {node}: {format_significant(alone)} {unit} alone"
            for module in sensitivity.findings
            for node, alone in module.blamed
        ]
        lines.append(self.written)
        if self.score is not None:
            loss = f"{format_significant(self.score.loss)} {self.score.unit}"
            lines.append(f"its loss: {loss}, limit {format_significant(self.limit)}")
        modules = table("Int8 module by module", columns, rows, note)
        return View(self.written, [modules], lines)


def measure_sensitivity(
    model: str | Path,
    frames: str | Path,
    output: str | Path,
    options: SensitivityOptions | None = None,
    listener: Listener = SILENT,
) -> SensitivityResult:
    """Measure what int8 costs module by module, and write a recipe within a limit.

    The nodes of the worst module are halved to find those to blame. The model is a
    float ONNX file or the name of one that ships; overrides lie beside the recipe where
    nodes stay float.

    Raises:
        GraphError: The model does not exist, or an output would harm an input.
        RecipeError: There is no such scheme, rule set or target.
        FramesError: Frames or saved ranges do not fit.
        PreconditionError: The graph is quantized already, or nothing can become int8.
    """
    options = options or SensitivityOptions()
    files = TrialFiles(model_path(model), Path(frames), Path(output))
    with files.claim_outputs(options):
        # calibrate once, try modules and nodes, then choose within the limit
        trials, modules = files.prepare(options, listener)
        report, most = partial(listener.on_progress, "modules"), options.node_trials
        sensitivity = analyse(trials, modules, node_trials=most, progress=report)
        choice = advise(trials, sensitivity, options.limit)
        written = files.write(choice, options)
        score = trials.score(choice) if choice.modules else None
    return SensitivityResult(
        files.output, sensitivity, choice, score, options.limit, written
    )


def _cells(score: Score) -> tuple[str, str]:
    worst = score.worst
    return format_significant(score.loss), f"{worst.name} {worst.sqnr_db:.1f}"
