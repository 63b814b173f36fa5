"""Commands that an extra brings: with it the command, without it one line of advice."""

import importlib.util

import typer

from me2e_compress.errors import MissingExtraError

_ROAD = ("highway_env", "cv2", "jinja2", "matplotlib", "scipy")
_ZOO = ("torch",)
_NAMES = ("evaluate", "routes", "score", "study")


def closed_loop(app: typer.Typer) -> None:
    """Add the commands that drive or score: the extra ``highway`` brings them."""
    if not _are_there(_ROAD):
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
    if not _are_there((*_ROAD, *_ZOO)):
        _advise_on(app, "train", "zoo,highway")
        return
    from me2e_compress.cli.commands.train import train

    app.command()(train)


def need_closed_loop(what: str) -> None:
    """Go on if the extra ``highway`` is installed.

    Raises:
        MissingExtraError: it is not, and ``what`` needs it.
    """
    if not _are_there(_ROAD):
        raise MissingExtraError(what, "highway")


def _advise_on(app: typer.Typer, name: str, extra: str) -> None:
    """Add a command that does nothing but say what to install."""

    def advise(context: typer.Context) -> None:
        raise MissingExtraError(f"what {context.info_name} needs", extra)

    anything = {"allow_extra_args": True, "ignore_unknown_options": True}
    app.command(name, context_settings=anything, help=f"Needs the extra {extra}.")(
        advise
    )


def _are_there(packages: tuple[str, ...]) -> bool:
    return all(importlib.util.find_spec(name) is not None for name in packages)
