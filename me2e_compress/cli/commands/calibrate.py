"""``me2e-compress calibrate``."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, show
from me2e_compress.runtime.providers import provider_named
from me2e_compress.workflows import calibrate as workflow
from me2e_compress.workflows.calibrate_options import CalibrateOptions

Frames = Annotated[
    Path | None, typer.Argument(help="the recorded FRAMES; --import needs none")
]
Output = Annotated[Path, typer.Option("-o", "--output", help="the ranges as JSON")]
Recipe = Annotated[str, typer.Option("-r", "--recipe", help=given.RECIPE)]
Cache = Annotated[Path | None, typer.Option(help="write a TensorRT cache too")]
Table = Annotated[Path | None, typer.Option(help="write onnxruntime's too: a folder")]


def calibrate(
    model: given.Model,
    frames: Frames = None,
    output: Output = Path("ranges.json"),
    recipe: Recipe = "exact",
    method: given.Method = None,
    count: given.Count = 256,
    module_map: given.ModuleMap = None,
    adapter: given.Adapter = None,
    imported: given.Import = None,
    tensorrt_cache: Cache = None,
    onnxruntime_table: Table = None,
    threads: given.Threads = 0,
    provider: given.Provider = "cpu",
    force: given.Force = False,
) -> None:
    """Measure the ranges of every tensor that any scheme, rule set or target needs.

    Frames are taken in whole scenes; of a recipe, the passes before int8 are run.
    A run that was killed goes on from OUTPUT.checkpoint; compress takes what is
    measured by --ranges.
    """
    options = CalibrateOptions(
        recipe=recipe, method=method, count=count, module_map=module_map,
        imported=imported, threads=threads, force=force, adapter=adapter,
        tensorrt_cache=tensorrt_cache, onnxruntime_table=onnxruntime_table,
        provider=provider_named(provider),
    )  # fmt: skip
    with listening() as listener:
        found = workflow.calibrate(model, frames, output, options, listener)
    show(found)
