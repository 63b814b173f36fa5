"""Commands that an extra brings: with it the command, without it one line of advice."""

import importlib.util

import typer

from me2e_compress.errors import MissingExtraError

_NEEDED = ("highway_env", "cv2", "jinja2", "matplotlib", "scipy")
_NAMES = ("evaluate", "routes", "score", "study")


def closed_loop(app: typer.Typer) -> None:
    """Add the commands that drive or score: the extra ``highway`` brings them."""
    if not _is_complete():
        for name in _NAMES:
            anything = {"allow_extra_args": True, "ignore_unknown_options": True}
            app.command(name, context_settings=anything)(_advise)
        return
    from me2e_compress.cli.evaluate import evaluate
    from me2e_compress.cli.routes import routes
    from me2e_compress.cli.score import score
    from me2e_compress.cli.study import study

    for command in (evaluate, routes, score, study):
        app.command()(command)


def _advise(context: typer.Context) -> None:
    """Say what to install: this command drives in closed loop."""
    raise MissingExtraError(f"what {context.info_name} needs", "highway")


def need_closed_loop(what: str) -> None:
    """Go on if the extra ``highway`` is installed.

    Raises:
        MissingExtraError: it is not, and ``what`` needs it.
    """
    if not _is_complete():
        raise MissingExtraError(what, "highway")


def _is_complete() -> bool:
    return all(importlib.util.find_spec(name) is not None for name in _NEEDED)
