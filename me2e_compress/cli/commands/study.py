"""``me2e-compress study``."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, say, show, tell
from me2e_compress.cli.verbosity import is_json
from me2e_compress.extras import need_extra

Provider = Annotated[
    str | None, typer.Option(help="runs the graph: cpu, cuda, ...; default the study's")
]
Routes = Annotated[str | None, typer.Option(help=f"{given.ROUTES}; not the study's")]
Tables = Annotated[str | None, typer.Option(help="only these of its blocks: A,B")]
DryRun = Annotated[
    bool, typer.Option("--dry-run", help="count drives and hours, drive nothing")
]
TrustCode = Annotated[
    bool, typer.Option("--trust-code", help="run Python and libraries that it names")
]


def study(
    definition: Annotated[Path, typer.Argument(help="STUDY.toml")],
    output: Annotated[Path, typer.Option("-o", "--output", help="the folder")],
    routes: Routes = None,
    tables: Tables = None,
    dry_run: DryRun = False,
    provider: Provider = None,
    trust_code: TrustCode = False,
    workers: given.Workers = 1,
    engine: given.Engine = "local",
    force: given.Force = False,
) -> None:
    """Drive variants under conditions and compare them; run it again to go on."""
    need_extra("highway", "a study")
    # takes highway-env and matplotlib two seconds to import
    from me2e_compress.evaluators.highway.evaluator import engine_of
    from me2e_compress.study import load_study
    from me2e_compress.study.run import run_study
    from me2e_compress.study.workload import workload
    from me2e_compress.study.workspace import HTML, JSON, MARKDOWN
    from me2e_compress.study.write import write_study
    from me2e_compress.workflows.checks import check_folder

    # read and check everything that the study needs before it starts
    asked = load_study(definition, routes, provider, trust_code=trust_code)
    if tables is not None:
        asked = asked.of_blocks(tables.split(","))
    inputs = (definition, *asked.inputs())
    check_folder(output, inputs, (JSON, MARKDOWN, HTML))
    ahead = workload(asked, output, workers)
    if dry_run:
        show(ahead)
        return
    # the report quotes the command that repeats the study
    options: list[tuple[str, str | None]] = [
        ("--routes", routes),
        ("--tables", tables),
        ("--provider", provider),
    ]
    chosen = [str(word) for each in options if each[1] is not None for word in each]
    chosen += ["--trust-code"] * trust_code
    words = ("me2e-compress", "study", str(definition), "-o", str(output), *chosen)
    # drive, or go on, and write the report
    tell(ahead.headline)
    with listening() as listener:
        name, address = given.engine_and_address(engine)
        chosen_engine = engine_of(name, workers, address)
        found = run_study(asked, output, chosen_engine, listener, force=force)
        files = write_study(found, output, words, force=force)
    show(found)
    if not is_json():
        say(f"wrote {files.report}, {files.tables} and {files.record}")
