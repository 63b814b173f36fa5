"""``me2e-compress compress``."""

import json
from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli.console import (
    console,
    file_bytes,
    megabytes,
    print_json,
)
from me2e_compress.cli.int8 import Int8Options
from me2e_compress.cli.job import choose, run, write, written
from me2e_compress.cli.models import model_path
from me2e_compress.cli.output import check_output, files_of
from me2e_compress.cli.tables import notes, steps_table, verification_table


def compress(
    model: Annotated[
        str, typer.Argument(help="the ONNX file, or highway; it is not changed")
    ],
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
    rules: Annotated[
        str | None, typer.Option(help="of the int8 plan: paper or tensorrt")
    ] = None,
    target: Annotated[
        str | None,
        typer.Option(help="who runs the int8 graph: tensorrt or onnxruntime"),
    ] = None,
    overrides: Annotated[
        Path | None, typer.Option(help="TOML file of exceptions to the int8 plan")
    ] = None,
    frames: Annotated[Path | None, typer.Option(help="the recorded FRAMES")] = None,
    ranges: Annotated[
        Path | None, typer.Option(help="saved RANGES.json instead of frames")
    ] = None,
    method: Annotated[
        str | None, typer.Option(help="of calibration: max-min, percentile:99.9, ...")
    ] = None,
    module_map: Annotated[
        str | None, typer.Option("--map", help="a preset or a TOML file")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="of everything random")] = 0,
    verify_frames: Annotated[
        int,
        typer.Option(min=0, help="frames that exact passes are checked on; 0: none"),
    ] = 2,
    as_json: Annotated[bool, typer.Option("--json", help="for programs")] = False,
) -> None:
    """Apply passes to a graph, check each, and write the smaller graph and a report."""
    source = model_path(model)
    int8 = Int8Options(scheme, rules, target, overrides, ranges, method)
    chosen = choose(recipe_name, passes, int8)
    read = (source, recipe_name, frames, module_map, *files_of(chosen))
    check_output(written(output), read)
    report = run(source, chosen, frames, module_map, seed, verify_frames, output.parent)
    report_path = write(report, source, output)
    if as_json:
        print_json(json.loads(report_path.read_text(encoding="utf-8")))
        return
    console.print(steps_table(report.steps))
    console.print(notes(report.steps))
    console.print(verification_table(report.verifications))
    before, after = file_bytes(source), file_bytes(output)
    console.print(
        f"{output}: {megabytes(after)} MB, {after / before:.1%} of {source.name};"
        f" report: {report_path}"
    )
