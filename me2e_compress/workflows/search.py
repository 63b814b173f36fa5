"""Find the modules whose int8 meets budgets and costs the plan least."""

import dataclasses
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from timeit import repeat

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import RecipeError
from me2e_compress.fidelity.sensitivity import Budget, Candidate, Int8Choice, Trials
from me2e_compress.fidelity.sensitivity import search as find
from me2e_compress.runtime.session import Session, replay
from me2e_compress.targets import DEFAULT_TARGET
from me2e_compress.workflows.budgets import check_budgets, joules_of, need_counter
from me2e_compress.workflows.checks import model_path
from me2e_compress.workflows.int8_trials import TrialFiles, TrialOptions
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.result import Result, Table, significant, table


@dataclasses.dataclass(frozen=True, kw_only=True)
class SearchOptions(TrialOptions):
    """How int8 is judged, and the budgets: one or more.

    Attributes:
        max_mb: most MB of weights.
        max_ms: most milliseconds per frame, on all cores of this CPU, so for its target
            alone.
        max_joules: most joules per frame, as a counter measures them.
    """

    max_mb: float | None = None
    max_ms: float | None = None
    max_joules: float | None = None

    def __post_init__(self) -> None:
        check_budgets(self.max_mb, self.max_ms, self.max_joules)
        if self.max_ms is not None and self.target != DEFAULT_TARGET:
            raise RecipeError(
                f"--max-ms is measured on this CPU, where int8 for {self.target} is"
                f" slow: use --target {DEFAULT_TARGET}"
            )


@dataclasses.dataclass(frozen=True, repr=False)
class SearchResult(Result):
    """What was tried, and the recipe; the last assignment fits and is the recipe's."""

    output: Path
    tried: tuple[Candidate, ...]
    limits: tuple[tuple[str, float], ...]
    written: str

    @property
    def headline(self) -> str:
        """The recipe."""
        return self.written

    def tables(self) -> tuple[Table, ...]:
        """Return what was tried, best first."""
        rows = [
            (
                ", ".join(each.modules) or "none",
                significant(None if each.score is None else each.score.loss),
                significant(each.loss),
                *map(significant, each.measured_costs or ()),
            )
            for each in self.tried
        ]
        units = [unit for unit, _ in self.limits]
        limits = " and ".join(
            f"{significant(limit, 6)} {unit}" for unit, limit in self.limits
        )
        columns = ("int8", "loss", "predicted", *units)
        note = f"budget: {limits}"
        return (table("Tried, best first", columns, rows, note),)

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
    files = TrialFiles(model_path(model), Path(frames), Path(output))
    with files.claimed(options):
        return _search(files, options, listener)


def _search(
    files: TrialFiles, options: SearchOptions, listener: Listener
) -> SearchResult:
    if options.max_joules is not None:
        need_counter()
    # calibrate once, then search variants of that one graph
    trials, modules = files.trials(options, listener)
    budgets = _budgets(options, trials)
    report = partial(listener.on_progress, "modules")
    tried = find(trials, modules, budgets, progress=report)
    choice = Int8Choice(tried[-1].modules)
    written = files.write(choice, options)
    limits = tuple((each.unit, each.limit) for each in budgets)
    return SearchResult(files.output, tried, limits, written)


def _budgets(options: SearchOptions, trials: Trials) -> list[Budget]:
    # sizes and seconds in base units, as they are measured
    found = list[Budget]()
    if options.max_mb is not None:
        found.append(Budget(options.max_mb * 1e6, "bytes of weights", _weight_bytes))
    if options.max_ms is not None:
        seconds = partial(_seconds, trials)
        found.append(Budget(options.max_ms / 1e3, "s", seconds))
    if options.max_joules is not None:
        joules = partial(_joules, trials)
        found.append(Budget(options.max_joules, "J", joules))
    return found


def _weight_bytes(made: ir.Model) -> float:
    return float(graph.size(made).weight_bytes)


def _joules(trials: Trials, made: ir.Model) -> float:
    # energy is measured of a file
    reference = trials.reference
    with TemporaryDirectory() as folder:
        file = Path(folder) / "int8.onnx"
        graph.save(made, file)
        provider = reference.session.provider
        return joules_of(file, reference.frames, provider)


def _seconds(trials: Trials, made: ir.Model) -> float:
    """Return the least wall time of a frame in 5 runs."""
    provider = trials.reference.session.provider
    session = Session(made, int8_kernels=True, release=True, provider=provider)
    first = next(iter(trials.reference.frames))
    times = repeat(lambda: list(replay(session, [first])), number=1, repeat=6)
    return min(times[1:])  # the first warms up
