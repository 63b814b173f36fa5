"""``me2e-compress compare``."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, show
from me2e_compress.errors import RecipeError
from me2e_compress.fidelity.floor import ALIVE
from me2e_compress.runtime.providers import provider_named
from me2e_compress.workflows import compare as workflow
from me2e_compress.workflows import compare_dump as against_engine
from me2e_compress.workflows.first_difference import first_difference


def compare(
    reference: Annotated[str, typer.Argument(help="graph to be true to")],
    candidate: Annotated[
        str, typer.Argument(help="the graph that is judged; not with --outputs")
    ],
    frames: Annotated[
        Path | None, typer.Argument(help="the recorded FRAMES", show_default=False)
    ] = None,
    as_it_stands: Annotated[
        bool,
        typer.Option(
            "--reference",
            help="the first without onnxruntime's optimizations, the second with all",
        ),
    ] = False,
    alive: given.Alive = ALIVE,
    outputs: Annotated[
        Path | None,
        typer.Option(help="what an engine of the graph answered: DUMP/ or JSON"),
    ] = None,
    float_graph: Annotated[
        str | None,
        typer.Option("--float", help="the graph's float source, with --outputs"),
    ] = None,
    where: Annotated[
        bool,
        typer.Option(
            "--first-difference",
            help="name the first module after which the second differs",
        ),
    ] = False,
    adapter: given.Adapter = None,
    module_map: given.ModuleMap = None,
    provider: given.Provider = "cpu",
) -> None:
    """Run two graphs over frames: SQNR of every output, plan displacement in metres.

    Exit code 1 if an output of the second hardly moves any more.
    """
    runs_on = provider_named(provider)
    if where and (as_it_stands or outputs is not None):
        raise RecipeError(
            "--first-difference holds two graphs together, all nodes as they stand:"
            " leave out --reference and --outputs"
        )
    if float_graph is not None and outputs is None:
        raise RecipeError("--float is for --outputs, which is not given")
    with listening() as listener:
        if outputs is not None and frames is None:
            dumped = against_engine.compare_dump(
                *(reference, outputs, candidate, listener),
                float_graph=float_graph, alive=alive, provider=runs_on,
                adapter=adapter, module_map=module_map,
            )  # fmt: skip
            show(dumped)
            return dumped.check()
        if outputs is not None or frames is None:
            said = "M.onnx FRAMES --outputs DUMP" if frames else "A.onnx B.onnx FRAMES"
            raise typer.BadParameter(f"expected {said}", param_hint="FRAMES")
        if where:
            place = first_difference(
                *(reference, candidate, frames, listener),
                provider=runs_on, adapter=adapter, module_map=module_map,
            )  # fmt: skip
            show(place)
            return
        found = workflow.compare(
            *(reference, candidate, frames, listener), as_it_stands=as_it_stands,
            alive=alive, provider=runs_on, adapter=adapter, module_map=module_map,
        )  # fmt: skip
    show(found)
    found.check()
