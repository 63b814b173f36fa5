"""Measure what int8 costs module by module, and write a recipe within a limit."""

import dataclasses
from functools import partial
from pathlib import Path

from me2e_compress.fidelity.sensitivity import (
    Int8Choice,
    Score,
    Sensitivity,
    advise,
    analyse,
)
from me2e_compress.workflows.checks import check_count, check_number, model_path
from me2e_compress.workflows.int8_trials import TrialFiles, TrialOptions
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.result import (
    Result,
    Table,
    counted,
    megabytes,
    significant,
    table,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SensitivityOptions(TrialOptions):
    """How int8 is judged, and what it may cost.

    Attributes:
        limit: largest loss of the recipe: metres that the plan moves; of a model
            whose plan is not known, noise of its worst output relative to the signal.
        node_trials: most variants that halve the worst module's nodes; 0 leaves nodes
            out.
    """

    limit: float = 0.1
    node_trials: int = 16

    def __post_init__(self) -> None:
        check_number("--limit", self.limit, zero=True)
        check_count("--node-trials", self.node_trials)


@dataclasses.dataclass(frozen=True, repr=False)
class SensitivityResult(Result):
    """What int8 costs, and the recipe.

    Attributes:
        score: loss of the choice; None where nothing is int8.
    """

    output: Path
    found: Sensitivity
    choice: Int8Choice
    score: Score | None
    limit: float
    written: str

    @property
    def headline(self) -> str:
        """The recipe."""
        return self.written

    def lines(self) -> tuple[str, ...]:
        """Return the nodes to blame, the recipe and its loss."""
        unit = self.found.together.unit
        blamed = [
            f"{each.module}: {node}: {significant(alone)} {unit} alone"
            for each in self.found.findings
            for node, alone in each.blamed
        ]
        cost = []
        if self.score is not None:
            loss = f"{significant(self.score.loss)} {self.score.unit}"
            cost.append(f"its loss: {loss}, limit {significant(self.limit)}")
        return *blamed, self.written, *cost

    def tables(self) -> tuple[Table, ...]:
        """Return what int8 costs module by module."""
        found = self.found
        rows = [
            (each.module, str(each.nodes), *_cells(each.score))
            for each in found.findings
        ]
        rows.append(("together", "", *_cells(found.together)))
        columns = ("module", "nodes", f"loss {found.together.unit}", "worst dB")
        size = megabytes(found.together.weight_bytes)
        note = f"{counted(found.trials, 'variant')} run; all together {size} MB"
        return (table("Int8 module by module", columns, rows, note),)

    def to_json(self) -> object:
        """Return what was found."""
        return self.found


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
    with files.claimed(options):
        return _measured(files, options, listener)


def _measured(
    files: TrialFiles, options: SensitivityOptions, listener: Listener
) -> SensitivityResult:
    # calibrate once, try modules and nodes, then choose within the limit
    trials, modules = files.trials(options, listener)
    found = analyse(
        trials,
        modules,
        node_trials=options.node_trials,
        progress=partial(listener.on_progress, "modules"),
    )
    choice = advise(trials, found, options.limit)
    written = files.write(choice, options)
    score = trials.score(choice) if choice.modules else None
    return SensitivityResult(files.output, found, choice, score, options.limit, written)


def _cells(score: Score) -> tuple[str, str]:
    worst = min(item.sqnr_db for item in score.fidelity.outputs)
    return significant(score.loss), f"{worst:.1f}"
