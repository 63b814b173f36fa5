"""Arguments and options that several commands take alike."""

from pathlib import Path
from typing import Annotated

import typer

Model = Annotated[str, typer.Argument(help="the ONNX file, or highway; not changed")]
FloatModel = Annotated[str, typer.Argument(help="the float ONNX file, or highway")]
Recording = Annotated[Path, typer.Argument(help="the recorded FRAMES")]
ModuleMap = Annotated[
    str | None, typer.Option("--map", help="vad, uniad, tcp, highway, or a TOML file")
]
Scheme = Annotated[
    str | None, typer.Option(help="int8 modules: feature-ext, prediction or full")
]
Rules = Annotated[
    str | None, typer.Option(help="of the int8 plan: safe, paper, or see list")
]
Target = Annotated[
    str | None, typer.Option(help="runtime of the int8 graph: tensorrt or onnxruntime")
]
Overrides = Annotated[
    Path | None, typer.Option(help="TOML file of exceptions to the int8 plan")
]
SavedRanges = Annotated[
    Path | None, typer.Option("--ranges", help="saved RANGES.json instead of frames")
]
Method = Annotated[
    str | None, typer.Option(help="of calibration: max-min, percentile:99.9, ...")
]
Seed = Annotated[int, typer.Option(min=0, help="of everything random")]
Threads = Annotated[int, typer.Option(min=0, help="of onnxruntime; 0 takes all")]
Workers = Annotated[int, typer.Option(min=1, help="routes at a time")]
Engine = Annotated[str, typer.Option(help="local or ray")]
Address = Annotated[str | None, typer.Option(help="of a Ray cluster")]
Adapter = Annotated[Path | None, typer.Option(help="TOML: adapts the model")]
SetDim = Annotated[
    list[str] | None,
    typer.Option(help="size of an open dimension: batch=1; once for each"),
]
Json = Annotated[bool, typer.Option("--json", help="for programs")]
RecipeOutput = Annotated[Path, typer.Option("-o", "--output", help="the RECIPE.toml")]
TrialScheme = Annotated[str, typer.Option("--scheme", help="modules that may be int8")]
TrialRules = Annotated[
    str, typer.Option("--rules", help="of the int8 plans: safe, paper, or see list")
]
JudgedFrames = Annotated[int, typer.Option("-n", "--count", help="frames to judge on")]
Routes = Annotated[str, typer.Option(help="all, a number, ID,ID or a file of routes")]
