"""One compression, from files to files: what ``compress`` and ``demo`` share."""

from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph, recipe
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.cli.console import progress
from me2e_compress.cli.int8 import Int8Options
from me2e_compress.errors import RecipeError
from me2e_compress.manager import PassManager, Report
from me2e_compress.modules import ModuleMap, map_of
from me2e_compress.passes import Context, Pass
from me2e_compress.quantization.plan import plan_of, save_plan
from me2e_compress.runtime.atomic import write_json


def choose(
    recipe_name: str | None, passes: str | None, int8: Int8Options
) -> tuple[Pass, ...]:
    """Build the passes that the options ask for.

    Raises:
        RecipeError: both a recipe and a pipeline, none of the three, or a bad one;
            options of int8 without int8.
    """
    if recipe_name is not None and passes is not None:
        raise RecipeError("give a recipe (-r) or a pipeline (--passes), not both")
    if recipe_name is not None:
        chosen = recipe.load(recipe_name)
    elif passes is not None:
        chosen = recipe.parse(passes)
    elif int8.scheme is not None:
        chosen = recipe.load("exact")
    else:
        raise RecipeError(
            f"say what to do: -r RECIPE ({', '.join(recipe.shipped())}), --passes TEXT"
            " or --scheme"
        )
    return int8.apply(chosen)


def run(
    model: Path,
    passes: tuple[Pass, ...],
    frames: Path | None,
    module_map: str | None,
    seed: int,
    verify_frames: int,
    reproducers: Path,
) -> Report:
    """Load, check the frames, run the passes."""
    loaded = graph.load(model)
    modules = map_of(loaded, module_map)
    recording = None
    if frames is not None:
        recording = CalibrationSet(frames)
        recording.check(loaded)
    manager = PassManager(passes, verify_frames, reproducers)
    with progress("passes") as advance:
        return manager.run(loaded, Context(modules, recording, seed), advance)


def run_on(model: ir.Model, passes: tuple[Pass, ...], modules: ModuleMap) -> ir.Model:
    """Run passes on a graph in memory, without frames and unverified."""
    return PassManager(passes, verify_frames=0).run(model, Context(modules)).model


def written(output: Path) -> tuple[Path, ...]:
    """Name the files that :func:`write` may write."""
    names = (output.name, output.name + ".data")
    beside = (f"{output.stem}.plan.json", f"{output.stem}.report.json")
    return tuple(output.with_name(name) for name in (*names, *beside))


def write(report: Report, source: Path, output: Path) -> Path:
    """Write the graph, and beside it what was done to it; give the report's path.

    A quantized graph has its plan beside it too, as ``OUTPUT.plan.json``.
    """
    graph.save(report.model, output)
    plan = plan_of(report.model)
    if plan is not None:
        save_plan(plan, output.with_name(output.stem + ".plan.json"))
    path = output.with_name(output.stem + ".report.json")
    write_json(path, report.record(source, output), indent=2)
    return path
