"""The application: all commands, and the options before or after their names."""

import inspect
from typing import Annotated

from cyclopts import App, Group, Parameter

from me2e_compress.base.extras import missing_module
from me2e_compress.cli import commands
from me2e_compress.cli.console import printing
from me2e_compress.version import __version__


def build_app(name: str, about: str = "") -> App:
    """Build an application without a command, with the options that all have."""

    def default_text(default: object) -> str | None:
        # Defaults that --help shows are numbers and words
        shown = isinstance(default, int | float | str) and default
        return str(default) if shown else None

    app = App(
        name,
        help=about or None,
        version=f"me2e-compress {__version__}",
        version_flags="--version",
        help_format="plaintext",
        default_parameter=Parameter(
            negative=(), show_default=default_text, allow_repeating=True
        ),
        result_action="return_value",
        exit_on_error=False,
        print_error=False,
    )

    @app.meta.default
    def launch(
        *tokens: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
        quiet: Annotated[bool, Parameter(name=["--quiet", "-q"])] = False,
        verbose: Annotated[bool, Parameter(name=["--verbose", "-v"])] = False,
        json: bool = False,
    ) -> None:
        """Take the options that stand before or behind the name of a command.

        Args:
            tokens: all other words
            quiet: only results and errors
            verbose: notes and node lists too
            json: print one JSON document
        """
        printing.quiet, printing.verbose = quiet, verbose and not quiet
        printing.json = json
        app(tokens)

    return app


# Commands in the order in which `--help` lists them
_PANELS = {
    "Start here": "demo doctor list",
    "Graphs and frames": "export inspect join split frames",
    "Compress": "plan calibrate compress lint sensitivity search",
    "Compare and measure": "compare profile",
    "Drive": "evaluate score study",
}
_NEED_HIGHWAY = ("evaluate", "study")
# The panel of every command
COMMANDS = {name: panel for panel, names in _PANELS.items() for name in names.split()}


def _main_app() -> App:
    """Build the application with every command, its help from its docstring."""
    about = "Make modular end-to-end driving models small, and prove that they drive."
    root = build_app("me2e-compress", about)
    root.register_install_completion_command()
    groups = {panel: Group(panel, sort_key=at) for at, panel in enumerate(_PANELS, 1)}
    for at, (name, panel) in enumerate(COMMANDS.items()):
        # `list` is Python's own
        function = getattr(commands, "list_entries" if name == "list" else name)
        text, _, _ = (inspect.getdoc(function) or "").partition("\n\nArgs:")
        first, *rest = (" ".join(part.split()) for part in text.split("\n\n"))
        if name in _NEED_HIGHWAY and missing_module("highway"):
            first += " Needs the extra highway."
        text = "\n\n".join([first, *rest])
        root.command(function, name=name, group=groups[panel], sort_key=at, help=text)
    return root


def options_of(name: str) -> list[str]:
    """List the options of a command, by their first names."""
    arguments = app[name].assemble_argument_collection()
    return [a.name for a in arguments if a.parse and a.name.startswith("-")]


app = _main_app()
