"""``me2e-compress compare``."""

from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, show
from me2e_compress.errors import RecipeError
from me2e_compress.runtime.providers import provider_named
from me2e_compress.workflows import compare as workflow
from me2e_compress.workflows.first_difference import first_difference


def compare(
    reference: Annotated[str, typer.Argument(help="graph or stack to be true to")],
    candidate: Annotated[str, typer.Argument(help="the graph that is judged")],
    frames: given.Recording,
    as_it_stands: Annotated[
        bool,
        typer.Option(
            "--reference",
            help="the first without onnxruntime's optimizations, the second with all",
        ),
    ] = False,
    where: Annotated[
        bool,
        typer.Option(
            "--first-difference",
            help="name the first module and node after which the second differs",
        ),
    ] = False,
    adapter: given.Adapter = None,
    provider: given.Provider = "cpu",
    plugins: given.Plugins = None,
) -> None:
    """Run two graphs over frames: SQNR of every output, plan displacement in metres."""
    if where:
        if as_it_stands:
            raise RecipeError("--first-difference runs all nodes as they stand already")
        with listening() as listener:
            place = first_difference(
                reference,
                candidate,
                frames,
                listener,
                provider=provider_named(provider, plugins or ()),
                adapter=adapter,
            )
        show(place)
        return
    with listening() as listener:
        found = workflow.compare(
            reference,
            candidate,
            frames,
            listener,
            as_it_stands=as_it_stands,
            provider=provider_named(provider, plugins or ()),
            adapter=adapter,
        )
    show(found)
