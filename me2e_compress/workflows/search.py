"""The modules whose int8 meets a budget and costs the plan least."""

import dataclasses
from functools import partial
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import RecipeError
from me2e_compress.runtime.interleaved import time_interleaved
from me2e_compress.runtime.session import Session
from me2e_compress.sensitivity import Budget, Candidate, Int8Choice, Trials
from me2e_compress.sensitivity import search as find
from me2e_compress.workflows.checks import check_number, model_path
from me2e_compress.workflows.int8_trials import TrialFiles, TrialOptions
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.result import Result, Table, number, table


@dataclasses.dataclass(frozen=True, kw_only=True)
class SearchOptions(TrialOptions):
    """How int8 is judged, and the budget: one of the two.

    Attributes:
        max_mb: most MB of weights.
        max_ms: most milliseconds a frame, on this CPU.

    Raises:
        RecipeError: no budget or two, one that is not positive and finite, or time on
            this CPU of int8 for another target.
    """

    max_mb: float | None = None
    max_ms: float | None = None

    def __post_init__(self) -> None:
        """Check the budget."""
        super().__post_init__()
        check_number("--max-mb", self.max_mb)
        check_number("--max-ms", self.max_ms)
        if (self.max_mb is None) == (self.max_ms is None):
            raise RecipeError("give a budget: --max-mb or --max-ms, one of the two")
        if self.max_ms is not None and self.runs_on != "onnxruntime":
            raise RecipeError(
                f"--max-ms is measured on this CPU, where int8 for {self.runs_on} is"
                " slow: use --target onnxruntime"
            )

    @property
    def runs_on(self) -> str:
        """The runtime of the int8 graph."""
        return self.target or ("tensorrt" if self.max_ms is None else "onnxruntime")


@dataclasses.dataclass(frozen=True, repr=False)
class SearchResult(Result):
    """What was tried, and the recipe.

    Attributes:
        output: the recipe that was written.
        tried: assignments; the last one fits and is the recipe's.
        unit: of the budget.
        written: what was written, in words.
    """

    output: Path
    tried: tuple[Candidate, ...]
    unit: str
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
                number(None if each.score is None else each.score.loss, ".4g"),
                f"{each.loss:.4g}",
                number(each.measured_cost, ".4g"),
            )
            for each in self.tried
        ]
        columns = ("int8", "loss", "predicted", self.unit)
        return (table("Tried, best first", columns, rows),)

    def records(self) -> list[dict[str, object]]:
        """Return a row an assignment."""
        return [
            {
                "modules": each.modules,
                "loss": None if each.score is None else each.score.loss,
                "predicted_loss": each.loss,
                "cost": each.measured_cost,
                "predicted_cost": each.cost,
                "unit": self.unit,
            }
            for each in self.tried
        ]

    def to_json(self) -> object:
        """Return what was tried."""
        return {"unit": self.unit, "tried": self.tried}


def search(
    model: str | Path,
    frames: str | Path,
    output: str | Path,
    options: SearchOptions,
    listener: Listener = SILENT,
) -> SearchResult:
    """Find the modules whose int8 meets a budget and costs the plan least.

    Args:
        model: the float ONNX file, or the name of one that ships.
        frames: folder of recorded frames.
        output: the recipe.
        options: with a budget.
        listener: is called with progress and warnings.

    Raises:
        GraphError: no such model, or the output would harm an input.
        RecipeError: no such scheme, rule set or target.
        FramesError: frames or saved ranges that do not fit.
        PreconditionError: the graph is quantized already, or nothing can be int8.
        EvaluationError: nothing fits; says what the least was.
    """
    files = TrialFiles(model_path(model), Path(frames), Path(output))
    with files.claimed(options):
        return _search(files, options, listener)


def _search(
    files: TrialFiles, options: SearchOptions, listener: Listener
) -> SearchResult:
    trials, modules = files.trials(options, options.runs_on, listener)
    if options.max_mb is not None:
        budget = Budget(
            options.max_mb * 1e6,
            "bytes of weights",
            lambda made: graph.size(made).weight_bytes,
        )
    else:
        seconds = partial(_seconds, trials, options.threads)
        budget = Budget((options.max_ms or 0) / 1e3, "s", seconds)
    report = partial(listener.on_progress, "modules")
    tried = find(trials, modules, budget, progress=report)
    choice = Int8Choice(tried[-1].modules)
    written = files.write(choice, options, options.runs_on)
    return SearchResult(files.output, tried, budget.unit, written)


def _seconds(trials: Trials, threads: int, made: ir.Model) -> float:
    """Return the least wall time of a frame, of 5."""
    provider = trials.reference.session.provider
    session = Session(made, threads=threads, release=True, provider=provider)
    first = next(iter(trials.reference.frames))
    return time_interleaved({"int8": session}, [first], 5)["int8"].best_wall_s
