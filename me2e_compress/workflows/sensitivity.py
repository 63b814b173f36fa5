"""Measure what int8 costs module by module, and write a recipe within a limit."""

import dataclasses
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.driving.policies import opened
from me2e_compress.errors import EvaluationError, RecipeError
from me2e_compress.extras import need_extra
from me2e_compress.fidelity.sensitivity import (
    Drive,
    Int8Choice,
    Score,
    Sensitivity,
    advise,
    analyse,
)
from me2e_compress.workflows.checks import (
    check_count,
    check_folder,
    check_number,
    model_path,
)
from me2e_compress.workflows.int8_trials import TrialFiles, TrialOptions
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.result import (
    Result,
    Table,
    counted,
    megabytes,
    number,
    significant,
    table,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SensitivityOptions(TrialOptions):
    """How int8 is judged, and what it may cost.

    Attributes:
        limit: largest loss of the recipe: metres that the plan moves; of a model
            whose plan is not known, noise of its worst output relative to the signal.
        drive: drive each module's int8 over these routes: ``all``, a number,
            ``ID,ID`` or a file.
        drive_limit: most points of driving score that the recipe may lose.
        workers: routes at a time.
        node_trials: most variants that halve the worst module's nodes; 0 leaves nodes
            out.
    """

    limit: float = 0.1
    drive: str | None = None
    drive_limit: float | None = None
    workers: int = 1
    node_trials: int = 16

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("--limit", self.limit, zero=True)
        check_number("--drive-limit", self.drive_limit, zero=True)
        check_count("--node-trials", self.node_trials)
        if self.drive is None and self.drive_limit is not None:
            raise RecipeError("--drive-limit says how to drive: add --drive")


@dataclasses.dataclass(frozen=True, repr=False)
class SensitivityResult(Result):
    """What int8 costs, and the recipe.

    Attributes:
        score: loss of the choice; None where nothing is int8.
        driving: driving score of the choice; None where nothing is driven.
    """

    output: Path
    found: Sensitivity
    choice: Int8Choice
    score: Score | None
    driving: float | None
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
        if self.driving is not None:
            whole = number(self.found.float_driving, ".1f")
            cost.append(f"its DS: {self.driving:.1f}, float {whole}")
        return *blamed, self.written, *cost

    def tables(self) -> tuple[Table, ...]:
        """Return what int8 costs module by module."""
        found, driven = self.found, self.found.float_driving is not None
        rows = [
            (each.module, str(each.nodes), *_cells(each.score, each.driving))
            for each in found.findings
        ]
        # the float model stands first, all modules together last
        if driven:
            whole = number(found.float_driving, ".1f")
            rows.insert(0, ("none", "", "0", "", whole))
        rows.append(("together", "", *_cells(found.together, found.driving)))
        # without drives the last column is left out
        columns = ("module", "nodes", f"loss {found.together.unit}", "worst dB", "DS")
        width = len(columns) if driven else len(columns) - 1
        size = megabytes(found.together.weight_bytes)
        note = f"{counted(found.trials, 'variant')} run; all together {size} MB"
        cells = [row[:width] for row in rows]
        return (table("Int8 module by module", columns[:width], cells, note),)

    def records(self) -> list[dict[str, object]]:
        """Return one row per module."""
        return [
            {
                "module": each.module,
                "nodes": each.nodes,
                "loss": each.score.loss,
                "unit": each.score.unit,
                "weight_bytes": each.score.weight_bytes,
                "driving": each.driving,
            }
            for each in self.found.findings
        ]

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
    nodes stay float. Where modules are driven, the episodes stay in ``RECIPE.drives``;
    run again, it goes on from them.

    Raises:
        GraphError: The model does not exist, or an output would harm an input.
        RecipeError: There is no such scheme, rule set or target.
        FramesError: Frames or saved ranges do not fit.
        PreconditionError: The graph is quantized already, or nothing can become int8.
        EvaluationError: The model cannot drive.
    """
    options = options or SensitivityOptions()
    files = TrialFiles(model_path(model), Path(frames), Path(output))
    with files.claimed(options, options.drive):
        return _measured(files, options, listener)


def _measured(
    files: TrialFiles, options: SensitivityOptions, listener: Listener
) -> SensitivityResult:
    # variants drive only on request: that takes hours
    drive = None
    if options.drive is not None:
        folder = files.output.with_name(files.output.stem + ".drives")
        check_folder(folder, (files.frames,))
        drive = _on_routes(options.drive, files.model, folder, options)
    # calibrate once, try modules and nodes, then choose within the limits
    trials, modules = files.trials(options, listener, drive)
    found = analyse(
        trials,
        modules,
        node_trials=options.node_trials,
        progress=partial(listener.on_progress, "modules"),
    )
    choice = advise(trials, found, options.limit, options.drive_limit)
    written = files.write(choice, options)
    score = trials.score(choice) if choice.modules else None
    driving = trials.driving(choice) if choice.modules else None
    return SensitivityResult(
        files.output, found, choice, score, driving, options.limit, written
    )


def _on_routes(
    routes: str, model: Path, folder: Path, options: SensitivityOptions
) -> Drive:
    """Return a function that drives a variant and gives its mean DS, percent.

    The model, which variants are made of, is tried before anything else. The folder
    keeps the episodes of each variant, which are not driven again.
    """
    need_extra("highway", "driving a variant")
    from me2e_compress.evaluators.highway.evaluator import DrivingOptions
    from me2e_compress.metrics.scores import score
    from me2e_compress.workflows.evaluate import driver_of

    # open the model before hours are spent on variants
    asked = DrivingOptions(routes=routes, workers=options.workers)
    _, set_size = asked.picked
    named = partial(
        driver_of, adapter=options.adapter, provider=options.provider,
        module_map=options.module_map,
    )  # fmt: skip
    opened(named(str(model)))

    def drive(choice: Int8Choice, variant: ir.Model) -> float:
        results = folder / _name_of(choice, variant)
        # the episodes stay, the variant's graph does not
        with TemporaryDirectory() as scratch:
            path = Path(scratch) / "variant.onnx"
            graph.save(variant, path)
            driver = named(str(path))
            episodes = tuple(asked.driven_by(driver, results).episodes())
            found = score(episodes, set_size).driving_score
        if found.value is None:
            raise EvaluationError(f"{results}: {found.measure.reason}")
        return found.value

    return drive


def _name_of(choice: Int8Choice, model: ir.Model) -> str:
    """Name a variant by its int8 modules and the digest of its graph."""
    modules = "+".join(choice.modules) or "float"
    return f"{modules}-{graph.digest(model)[:12]}"


def _cells(score: Score, driving: float | None) -> tuple[str, str, str]:
    worst = min(item.sqnr_db for item in score.fidelity.outputs)
    return significant(score.loss), f"{worst:.1f}", number(driving, ".1f")
