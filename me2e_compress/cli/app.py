"""All commands together."""

import typer

from me2e_compress.cli.commands.calibrate import calibrate
from me2e_compress.cli.commands.compare import compare
from me2e_compress.cli.commands.compress import compress
from me2e_compress.cli.commands.demo import demo
from me2e_compress.cli.commands.doctor import doctor
from me2e_compress.cli.commands.export import export
from me2e_compress.cli.commands.frames import frames
from me2e_compress.cli.commands.inspect import inspect
from me2e_compress.cli.commands.lint import lint
from me2e_compress.cli.commands.list import list_entries
from me2e_compress.cli.commands.plan import plan
from me2e_compress.cli.commands.profile import profile
from me2e_compress.cli.commands.search import search
from me2e_compress.cli.commands.sensitivity import sensitivity
from me2e_compress.errors import MissingExtraError
from me2e_compress.workflows.extras import ROAD, ZOO, are_there

CLOSED_LOOP = ("evaluate", "routes", "score", "study")
"""Commands that drive or score."""

app = typer.Typer(
    name="me2e-compress",
    help="Make modular end-to-end driving models small, and prove that they drive.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for command in (
    demo, doctor, export, inspect, frames, calibrate, plan, compress, lint, compare,
    profile, sensitivity, search,
):  # fmt: skip
    app.command()(command)
app.command("list")(list_entries)


def add_closed_loop(app: typer.Typer) -> None:
    """Add the commands that drive or score: the extra ``highway`` brings them."""
    if not are_there(ROAD):
        for name in CLOSED_LOOP:
            _advise_on(app, name, "highway")
        return
    from me2e_compress.cli.commands.evaluate import evaluate
    from me2e_compress.cli.commands.routes import routes
    from me2e_compress.cli.commands.score import score
    from me2e_compress.cli.commands.study import study

    for command in (evaluate, routes, score, study):
        app.command()(command)


def add_training(app: typer.Typer) -> None:
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


add_closed_loop(app)
add_training(app)
