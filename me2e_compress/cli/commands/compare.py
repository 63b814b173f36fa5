"""``me2e-compress compare``."""

from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, show
from me2e_compress.fidelity.floor import ALIVE
from me2e_compress.runtime.providers import provider_named
from me2e_compress.workflows import compare as workflow


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
    alive: given.Alive = ALIVE,
    adapter: given.Adapter = None,
    provider: given.Provider = "cpu",
    plugins: given.Plugins = None,
) -> None:
    """Run two graphs over frames: SQNR of every output, plan displacement in metres.

    Exit code 1 if an output of the second does not answer its inputs any more.
    """
    with listening() as listener:
        found = workflow.compare(
            reference,
            candidate,
            frames,
            listener,
            as_it_stands=as_it_stands,
            alive=alive,
            provider=provider_named(provider, plugins or ()),
            adapter=adapter,
        )
    show(found)
    found.check()
