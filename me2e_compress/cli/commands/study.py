"""``me2e-compress study``."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, say, show

Provider = Annotated[
    str | None, typer.Option(help="runs the models: cpu, cuda, ...; not the study's")
]
Routes = Annotated[str | None, typer.Option(help=f"{given.ROUTES}; not the study's")]


def study(
    definition: Annotated[Path, typer.Argument(help="STUDY.toml")],
    output: Annotated[Path, typer.Option("-o", "--output", help="the folder")],
    routes: Routes = None,
    provider: Provider = None,
    plugins: given.Plugins = None,
    workers: given.Workers = 1,
    engine: given.Engine = "local",
    address: given.Address = None,
    force: given.Force = False,
    as_json: given.Json = False,
) -> None:
    """Drive variants under conditions and compare them; run it again to go on."""
    # takes highway-env and matplotlib two seconds to import
    from me2e_compress.evaluators.highway.evaluation_options import engine_of
    from me2e_compress.study import load_study, run_study
    from me2e_compress.study.workspace import HTML, JSON, MARKDOWN
    from me2e_compress.study.write import write_study
    from me2e_compress.workflows.checks import check_folder

    asked = load_study(definition, routes, provider, plugins or ())
    check_folder(output, (definition,), (JSON, MARKDOWN, HTML))
    with listening() as listener:
        chosen_engine = engine_of(engine, workers, address)
        found = run_study(asked, output, chosen_engine, listener, force=force)
    chosen = [] if routes is None else ["--routes", routes]
    chosen += [] if provider is None else ["--provider", provider]
    chosen += [word for each in plugins or () for word in ("--plugins", str(each))]
    words = ("me2e-compress", "study", str(definition), "-o", str(output), *chosen)
    written = write_study(found, output, words, force=force)
    show(found, as_json)
    if not as_json:
        say(f"{written.report}, {written.tables} and {written.record} are yours.")
