"""``me2e-compress profile``."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, show, tell
from me2e_compress.errors import EvaluationError
from me2e_compress.metrics.deadlines import BUDGET_MS
from me2e_compress.runtime.providers import provider_named
from me2e_compress.workflows import profile as workflow
from me2e_compress.workflows.import_profile import import_profile, refuse_both


def profile(
    model: given.Model,
    output: Annotated[Path, typer.Option("-o", "--output", help="the trace")],
    frames: Annotated[
        Path | None, typer.Argument(help="the recorded FRAMES; none for --import")
    ] = None,
    imported: given.Import = None,
    samples: Annotated[int | None, typer.Option(help="number of latencies")] = None,
    threads: given.Threads = 1,
    by_module: Annotated[
        bool, typer.Option("--by-module", help="modules and operators too")
    ] = False,
    figure: Annotated[
        Path | None, typer.Option(help="draw modules over inferences: PNG, SVG, PDF")
    ] = None,
    energy: Annotated[
        str | None,
        typer.Option(help="joules too: auto, nvml, recorded:FILE"),
    ] = None,
    budget_ms: given.Budget = BUDGET_MS,
    module_map: given.ModuleMap = None,
    adapter: given.Adapter = None,
    provider: given.Provider = "cpu",
    force: given.Force = False,
) -> None:
    """Measure a model alone and warm, and write its latencies as a trace.

    With --import nothing is run: the latencies are those that another tool measured.
    """
    # a measurement and an import share the options that both understand
    device = provider_named(provider)
    options = workflow.ProfileOptions(
        samples,
        threads=threads,
        provider=device,
        by_module=by_module,
        module_map=module_map,
        figure=figure,
        force=force,
        energy=energy,
        budget_ms=budget_ms,
        adapter=adapter,
    )
    with listening() as listener:
        if imported is not None:
            refuse_both(frames, options)
            found = import_profile(
                model, [imported], output, budget_ms=budget_ms, force=force
            )
        elif frames is None:
            raise EvaluationError("profile: give recorded FRAMES, or --import FILE")
        else:
            found = workflow.profile(model, frames, output, options, listener)
    show(found)
    # files besides the trace are named on stderr
    if found.figure is not None:
        tell(f"wrote {found.figure}")
    if found.energy_output is not None:
        tell(f"wrote {found.energy_output}")
