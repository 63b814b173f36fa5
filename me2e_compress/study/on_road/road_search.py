"""Search for the scheme to ship: within the budgets, and best on the road."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from me2e_compress import graph
from me2e_compress.driving.policies import driver_named
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.evaluators.highway.engine import Engine, LocalEngine
from me2e_compress.evaluators.highway.evaluator import routes_named
from me2e_compress.manager import recipe
from me2e_compress.registry import marks
from me2e_compress.runtime.atomic import write_bytes
from me2e_compress.study.condition import Condition
from me2e_compress.study.definition import Study, Timing, Variant
from me2e_compress.study.on_road.grid import GridModules, GridPoint
from me2e_compress.study.on_road.halving import Rung, drives, halve, stratified
from me2e_compress.study.on_road.road_drives import RoadDrives, make_drives
from me2e_compress.study.on_road.road_options import RoadSearchOptions
from me2e_compress.study.on_road.road_result import RoadSearchResult
from me2e_compress.study.workload import workload
from me2e_compress.workflows.budgets import joules_here
from me2e_compress.workflows.checks import check_folder, load_map, model_path
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.result import counted, duration, number

BASELINE = "float"
"""The unchanged model, with which all schemes are compared."""
CONDITION = "road"


def search_on_road(
    model: str | Path,
    frames: str | Path,
    output: str | Path,
    options: RoadSearchOptions,
    engine: Engine | None = None,
    listener: Listener = SILENT,
    tell: Callable[[str], None] = lambda line: None,
) -> RoadSearchResult:
    """Find the scheme within the budgets that drives best, by successive halving.

    The schemes are every module group in float or int8, times the modules that are
    removed. All are made, weighed and timed; those within the budgets drive the same
    routes with the same seeds, the better half more of them, the last two all. With the
    same folder of drives, a search resumes.

    Args:
        model: The float ONNX file, or the name of one that ships.
        frames: Recorded frames, for int8 calibration and the means of removed modules.
        output: The recipe of the winner.
        options: Budgets, grid and road.
        engine: Where routes are driven; None for one process of this machine.
        listener: Is called with progress and warnings.
        tell: Is called with a forecast of the work, and with each rung.

    Raises:
        GraphError: There is no such model, or the output would harm an input.
        RecipeError: A module does not exist or cannot be removed.
        FramesError: Frames do not fit.
        StudyError: The folder of drives belongs to another search.
        EvaluationError: Nothing fits the budgets (the message names the least cost), or
            the model cannot drive.
        EnergyError: An energy counter responds but is not usable.
    """
    # check the outputs before hours of work
    path, recipe_file = model_path(model), Path(output)
    inputs = (path, frames, options.module_map, options.adapter)
    check_folder(options.drives, inputs)
    with writing([recipe_file], inputs, folders=[options.drives], force=options.force):
        study, grid = planned(path, Path(frames), options)
        tell(ahead(study, grid, options, engine))
        # make and weigh all schemes, drive those within the budgets
        made = make_drives(
            study, options.drives, joules_here(), engine or LocalEngine(), listener
        )
        fitting = within(made, options)
        rungs = climbed(made, fitting, options, tell)
        winner = rungs[-1].standings[0].name
        text = marks.IN_TOML + recipe.to_toml(
            grid[winner].passes(options.rules, options.target, options.dims)
        )
        write_bytes(recipe_file, text.encode())
    return RoadSearchResult(
        recipe_file, options.limits, grid, made, rungs, made.difference(winner)
    )


def planned(
    path: Path, frames: Path, options: RoadSearchOptions
) -> tuple[Study, dict[str, GridPoint]]:
    """Return the study of a grid, and its points by the names of their variants."""
    # the grid of the model's modules
    loaded = graph.load(path)
    modules = GridModules.of(loaded, load_map(options.module_map, loaded))
    points = modules.grid(options.modules, options.ablate, options.most_ablated)
    grid = {each.name: each for each in points}
    # routes, and the float model as the baseline
    routes, set_size = routes_named(options.routes)
    driver = driver_named(str(path), options.adapter)
    adapter = driver.adapter if isinstance(driver, OnnxDriver) else None
    baseline = Variant(BASELINE, str(path), (), options.module_map, adapter)
    variants = [
        replace(
            baseline,
            name=name,
            passes=point.passes(options.rules, options.target, options.dims),
        )
        for name, point in grid.items()
    ]
    # one condition, with routes mixed from the first on
    study = Study(
        title=f"search {path.name}",
        variants=(baseline, *variants),
        conditions=(Condition(CONDITION, options.latency),),
        baseline=BASELINE,
        routes=stratified(routes, options.seed),
        set_size=set_size,
        frames=frames,
        held_out=frames,
        timing=Timing(options.samples, options.threads, options.baseline_median_s),
        seed=options.seed,
        provider=options.provider,
    )
    study.check_recordings()
    return study, grid


def ahead(
    study: Study,
    grid: dict[str, GridPoint],
    options: RoadSearchOptions,
    engine: Engine | None,
) -> str:
    """Say how many schemes there are, and about how long they drive at most."""
    workers = engine.workers if isinstance(engine, LocalEngine) else 1
    whole = workload(study, options.drives, workers)
    of_all = len(study.variants) * len(study.routes)
    driven = drives(len(grid), len(study.routes), options.first_rung)
    hours = whole.hours * driven / of_all
    how = "by this folder's logs" if whole.measured else "an estimate"
    return (
        f"{counted(len(grid), 'scheme')}; if all are within the budgets, {driven:,} of"
        f" {of_all:,} routes are driven: about {duration(3600 * hours)} on"
        f" {counted(workers, 'worker')} ({how}), besides making and timing the models"
    )


def within(made: RoadDrives, options: RoadSearchOptions) -> tuple[str, ...]:
    """Return the schemes within the budgets, the cheapest first, each file once."""
    limits, weighed = options.limits, made.weighed
    ours = [name for name in made.prepared if name != BASELINE]
    if not ours:
        first = next(iter(made.failures.values()), "")
        raise EvaluationError(f"no scheme could be made: {first}")
    fitting = [name for name in ours if limits.spent(weighed[name]) <= 1]
    if not fitting:
        whole = weighed[BASELINE]
        found = [weighed[name] for name in ours]
        raise EvaluationError(limits.refusal(whole, found, made.joules))
    once = {made.prepared[name].sha256: name for name in reversed(fitting)}
    return tuple(sorted(once.values(), key=lambda name: limits.spent(weighed[name])))


def climbed(
    made: RoadDrives,
    fitting: Sequence[str],
    options: RoadSearchOptions,
    tell: Callable[[str], None] = lambda line: None,
) -> tuple[Rung, ...]:
    """Drive the schemes by successive halving."""

    def told(rung: Rung) -> None:
        best = rung.standings[0]
        left = sum(each.kept for each in rung.standings)
        tell(
            f"{counted(rung.routes, 'route')}:"
            f" {counted(len(rung.standings), 'scheme')}, best {best.name}"
            f" ({number(best.difference, '+.1f')} DS against float); {left} kept"
        )

    routes = made.study.routes
    return halve(fitting, routes, options.first_rung, made.differ, told)
