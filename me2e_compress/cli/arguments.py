"""Arguments and options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli.verbosity import set_json

Model = Annotated[str, typer.Argument(help="the ONNX file, or highway; not changed")]
FloatModel = Annotated[str, typer.Argument(help="the ONNX file, or highway; float")]
Stack = Annotated[Path, typer.Argument(help="the TOML file that names the files")]
Recording = Annotated[Path, typer.Argument(help="the recorded FRAMES")]
ModuleMap = Annotated[
    str | None, typer.Option("--map", help="vad, uniad, tcp, highway, or a TOML file")
]
Scheme = Annotated[
    str | None, typer.Option(help="int8 modules: feature-ext, prediction or full")
]
Rules = Annotated[
    str | None, typer.Option(help="rules of the int8 plan: safe, paper, or see list")
]
TARGET = "runtime of the graph: onnxruntime or tensorrt"
Target = Annotated[str | None, typer.Option(help=TARGET)]
Overrides = Annotated[
    Path | None, typer.Option(help="TOML file of exceptions to the int8 plan")
]
SavedRanges = Annotated[
    Path | None, typer.Option("--ranges", help="saved RANGES.json instead of frames")
]
Method = Annotated[
    str | None,
    typer.Option(help="calibration method: mse, max-min, percentile:99.9, ..."),
]
RECIPE = "a TOML file, or a shipped recipe's name"
Recipe = Annotated[str | None, typer.Option("-r", "--recipe", help=RECIPE)]
Count = Annotated[int, typer.Option("-n", "--count", help="number of frames")]
Seed = Annotated[int, typer.Option(min=0, help="seed of everything random")]
Provider = Annotated[
    str,
    typer.Option(help="runs the graph: cpu, cuda{plugins=[LIB.so]}, ... or see list"),
]
Threads = Annotated[int, typer.Option(min=0, help="of onnxruntime; 0 takes all")]
Workers = Annotated[int, typer.Option(min=1, help="processes at a time")]
Engine = Annotated[str, typer.Option(help="local, ray, or ray:ADDRESS of a cluster")]


def engine_and_address(text: str) -> tuple[str, str | None]:
    """Split ``ray:ADDRESS``; None stands for a cluster of its own, or for none."""
    name, _, address = text.partition(":")
    return name, address or None


Adapter = Annotated[
    Path | None, typer.Option(help="adapts the model: A.toml, or see list")
]
SetDim = Annotated[
    list[str] | None,
    typer.Option(help="size of an open dimension: batch=1; once for each"),
]
Force = Annotated[
    bool, typer.Option("--force", help="replace what is there, whoever wrote it")
]


Json = Annotated[
    bool,
    typer.Option(
        "--json",
        help="print one JSON document",
        callback=set_json,
        expose_value=False,
    ),
]
RecipeOutput = Annotated[Path, typer.Option("-o", "--output", help="the RECIPE.toml")]
TrialScheme = Annotated[
    str,
    typer.Option("--scheme", help="int8 modules: those to choose from, as a scheme"),
]
TrialRules = Annotated[
    str,
    typer.Option("--rules", help="rules of the int8 plan: safe, paper, or see list"),
]
TrialTarget = Annotated[str, typer.Option("--target", help=TARGET)]
JudgedFrames = Annotated[
    int, typer.Option("-n", "--count", help="number of frames (to judge on)")
]
ROUTES = "routes: all, a number, ID,ID"
Routes = Annotated[str, typer.Option(help=f"{ROUTES}; or a file of routes")]
Budget = Annotated[
    float, typer.Option("--budget-ms", help="what a decision may take; 20 Hz: 50")
]
Alive = Annotated[
    float,
    typer.Option(help="least share of an output's movement that is left; 0: not asked"),
]
Import = Annotated[
    Path | None, typer.Option("--import", help="what another tool measured")
]
