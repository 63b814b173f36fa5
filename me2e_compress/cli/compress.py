"""``me2e-compress compress``."""

import json
from pathlib import Path
from typing import Annotated

import onnx_ir as ir
import typer

from me2e_compress import graph, recipe
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.cli.console import (
    console,
    file_bytes,
    megabytes,
    print_json,
    progress,
)
from me2e_compress.cli.tables import steps_table, verification_table
from me2e_compress.errors import GraphError, ModuleMapError, RecipeError
from me2e_compress.manager import PassManager, Report
from me2e_compress.modules import ModuleMap, detect
from me2e_compress.passes import Context, Pass
from me2e_compress.passes.quantize_int8 import QuantizeInt8


def compress(
    model: Annotated[Path, typer.Argument(help="the ONNX file; it is not changed")],
    output: Annotated[Path, typer.Option("-o", "--output", help="the smaller one")],
    recipe_name: Annotated[
        str | None,
        typer.Option("-r", "--recipe", help="a TOML file, or a shipped recipe's name"),
    ] = None,
    passes: Annotated[
        str | None,
        typer.Option(help="a pipeline: fold-constants,ablate-modules{drop=[occ]}"),
    ] = None,
    scheme: Annotated[
        str | None,
        typer.Option(help="int8 modules: feature-ext, prediction or full"),
    ] = None,
    frames: Annotated[Path | None, typer.Option(help="the recorded FRAMES")] = None,
    module_map: Annotated[
        str | None, typer.Option("--map", help="vad, uniad, tcp, or a TOML file")
    ] = None,
    seed: Annotated[int, typer.Option(help="of everything random")] = 0,
    verify_frames: Annotated[
        int, typer.Option(help="frames that exact passes are checked on; 0: none")
    ] = 2,
    as_json: Annotated[bool, typer.Option("--json", help="for programs")] = False,
) -> None:
    """Apply passes to a graph, check each, and write the smaller graph and a report."""
    check_output(model, output)
    chosen = choose(recipe_name, passes, scheme)
    report = run(model, chosen, frames, module_map, seed, verify_frames, output.parent)
    report_path = write(report, model, output)
    if as_json:
        print_json(json.loads(report_path.read_text(encoding="utf-8")))
        return
    console.print(steps_table(report.steps))
    console.print(verification_table(report.verifications))
    before, after = file_bytes(model), file_bytes(output)
    console.print(
        f"{output}: {megabytes(after)} MB, {after / before:.1%} of {model.name};"
        f" report: {report_path}"
    )


def check_output(model: Path, output: Path) -> None:
    """Refuse before any work what could not be written, or would harm the input.

    Raises:
        GraphError: the output is the input, or its folder does not exist.
    """
    if output.exists() and model.exists() and output.samefile(model):
        raise GraphError(f"{output} is the input: choose another name for the output")
    if not output.parent.is_dir():
        raise GraphError(f"{output}: no such folder {output.parent}")


def choose(
    recipe_name: str | None, passes: str | None, scheme: str | None
) -> tuple[Pass, ...]:
    """Build the passes that the options ask for.

    Raises:
        RecipeError: both a recipe and a pipeline, none of the three, or a bad one.
    """
    if recipe_name is not None and passes is not None:
        raise RecipeError("give a recipe (-r) or a pipeline (--passes), not both")
    if recipe_name is not None:
        chosen = recipe.load(recipe_name)
    elif passes is not None:
        chosen = recipe.parse(passes)
    elif scheme is not None:
        chosen = recipe.load("exact")
    else:
        raise RecipeError(
            f"say what to do: -r RECIPE ({', '.join(recipe.shipped())}), --passes TEXT"
            " or --scheme"
        )
    if scheme is not None:
        chosen = (*chosen, QuantizeInt8(scheme=scheme))
    return chosen


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
    modules = modules_of(loaded, module_map)
    recording = None
    if frames is not None:
        recording = CalibrationSet(frames)
        recording.check(loaded)
    manager = PassManager(passes, verify_frames, reproducers)
    with progress("passes") as advance:
        return manager.run(loaded, Context(modules, recording, seed), advance)


def modules_of(model: ir.Model, module_map: str | None) -> ModuleMap:
    """Load the map that is asked for, or find the preset that fits.

    A graph that no preset fits is one module, named ``model``.
    """
    if module_map is not None:
        return ModuleMap.load(module_map)
    try:
        return detect(model)
    except ModuleMapError:
        return ModuleMap.whole()


def write(report: Report, source: Path, output: Path) -> Path:
    """Write the graph, and beside it what was done to it; give the report's path."""
    graph.save(report.model, output)
    path = output.with_name(output.stem + ".report.json")
    text = json.dumps(report.record(source, output), indent=2)
    graph.write_text(path, text + "\n")
    return path
