"""``me2e-compress compress``."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, show
from me2e_compress.errors import RecipeError
from me2e_compress.fidelity.floor import SQNR_FLOOR_DB
from me2e_compress.manager import recipe
from me2e_compress.runtime.providers import provider_named
from me2e_compress.workflows import compress as workflow
from me2e_compress.workflows.checks import sizes

Output = Annotated[Path, typer.Option("-o", "--output", help="the smaller graph")]
Passes = Annotated[str | None, typer.Option(help="a pipeline, as text; see above")]
Verify = Annotated[int, typer.Option(min=0, help="frames to check exact passes on")]
Unproven = Annotated[
    bool, typer.Option("--unproven", help="write it although it does not run here")
]
Measure = Annotated[int, typer.Option(min=0, help="most frames kept to measure on")]
Floor = Annotated[float, typer.Option(help="warn of an output below this SQNR, in dB")]


def compress(
    model: given.Model,
    output: Output,
    recipe_name: given.Recipe = None,
    passes: Passes = None,
    scheme: given.Scheme = None,
    rules: given.Rules = None,
    target: given.Target = None,
    overrides: given.Overrides = None,
    frames: Annotated[Path | None, typer.Option(help="the recorded FRAMES")] = None,
    ranges: given.SavedRanges = None,
    method: given.Method = None,
    module_map: given.ModuleMap = None,
    verify_frames: Verify = 2,
    unproven: Unproven = False,
    measure_frames: Measure = 8,
    floor: Floor = SQNR_FLOOR_DB,
    set_dim: given.SetDim = None,
    adapter: given.Adapter = None,
    provider: given.Provider = "cpu",
    force: given.Force = False,
) -> None:
    """Apply passes to a graph, check each, and write the smaller graph and a report.

    A pipeline names passes in order: fold-constants,fuse-basic{swish=true}
    """
    if recipe_name is not None and passes is not None:
        raise RecipeError("give a recipe (-r) or a pipeline (--passes), not both")
    wanted = recipe_name if passes is None else recipe.parse(passes)
    options = workflow.CompressOptions(
        scheme=scheme, rules=rules, target=target, overrides=overrides, ranges=ranges,
        method=method, module_map=module_map, verify_frames=verify_frames,
        measure_frames=measure_frames, floor=floor, force=force,
        dims=sizes(set_dim or ()), adapter=adapter, unproven=unproven,
        provider=provider_named(provider),
    )  # fmt: skip
    with listening() as listener:
        found = workflow.compress(model, output, wanted, frames, options, listener)
    show(found)
    found.check()
