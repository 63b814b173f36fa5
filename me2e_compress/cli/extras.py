"""Commands that an extra brings: with it the command, without it one line of advice."""

import typer

from me2e_compress.errors import MissingExtraError
from me2e_compress.workflows.extras import ROAD, ZOO, are_there

_NAMES = ("evaluate", "routes", "score", "study")


def closed_loop(app: typer.Typer) -> None:
    """Add the commands that drive or score: the extra ``highway`` brings them."""
    if not are_there(ROAD):
        for name in _NAMES:
            _advise_on(app, name, "highway")
        return
    from me2e_compress.cli.commands.evaluate import evaluate
    from me2e_compress.cli.commands.routes import routes
    from me2e_compress.cli.commands.score import score
    from me2e_compress.cli.commands.study import study

    for command in (evaluate, routes, score, study):
        app.command()(command)


def training(app: typer.Typer) -> None:
    """Add the command that trains: it takes the extras ``zoo`` and ``highway``."""
    if not are_there((*ROAD, *ZOO)):
        _advise_on(app, "train", "zoo,highway")
        return
    from me2e_compress.cli.commands.train import train

    app.command()(train)


def _advise_on(app: typer.Typer, name: str, extra: str) -> None:
    """Add a command that does nothing but say what to install."""

    def advise(context: typer.Context) -> None:
        raise MissingExtraError(f"what {context.info_name} needs", extra)

    anything = {"allow_extra_args": True, "ignore_unknown_options": True}
    app.command(name, context_settings=anything, help=f"Needs the extra {extra}.")(
        advise
    )
