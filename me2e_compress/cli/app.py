"""All commands together; the code of each is imported when it is called."""

import importlib
from dataclasses import dataclass
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from me2e_compress.cli import arguments as given
from me2e_compress.cli.verbosity import Verbosity, set_verbosity
from me2e_compress.errors import FORMER
from me2e_compress.extras import missing_module
from me2e_compress.version import __version__


@dataclass(frozen=True)
class CommandEntry:
    """What is known of a command before its code is imported.

    Attributes:
        panel: the panel of ``--help`` that lists it.
        name: the command's name, also of its file and its function.
        help: the first line of its docstring.
        extra: extras of the package that its work needs, or empty.
    """

    panel: str
    name: str
    help: str
    extra: str = ""

    @property
    def function(self) -> str:
        """The name of its function; ``list`` is Python's own."""
        return "list_entries" if self.name == "list" else self.name

    def line(self) -> str:
        """Return the command's line in the list of commands."""
        if self.extra and missing_module(self.extra):
            return f"{self.help} Needs the extra {self.extra}."
        return self.help

    def load(self) -> Any:
        """Import the command as a Click command; its options need no extra."""
        alone = _app()
        home = importlib.import_module(f"me2e_compress.cli.commands.{self.name}")
        alone.command(self.name)(getattr(home, self.function))
        return typer.main.get_command(alone)


_PANELS = {
    "Start here": {
        "demo": (
            "Run the main job on what ships: compress, verify, compare, drive, report."
        ),
        "doctor": "Show what this machine can do, and what to install for the rest.",
        "list": (
            "Show what can be named: ours, and what other packages add by entry point."
        ),
    },
    "Graphs and frames": {
        "export": "Write a trained driver that ships.",
        "inspect": (
            "Show what a graph holds: interface, and nodes, parameters, MACs by module."
        ),
        "join": "Join the files of a model into one graph, which all commands take.",
        "split": "Cut a graph that was joined, and made smaller, into its files again.",
        "frames": "Write calibration frames, coherent in time, seen by six cameras.",
    },
    "Compress": {
        "plan": (
            "Show which nodes become int8, which stay float, by which rule, and why."
        ),
        "calibrate": (
            "Measure the ranges of every tensor that any scheme, rule set or target"
            " needs."
        ),
        "ranges": (
            "Say which saved ranges deserve a look, and what to record instead."
        ),
        "compress": (
            "Apply passes to a graph, check each, and write the smaller graph and a"
            " report."
        ),
        "lint": (
            "Check a graph for the runtime that will run it; exit code 1 if it refuses."
        ),
        "build": "Build a TensorRT engine of a graph, for the GPU of this machine.",
        "sensitivity": (
            "Measure what int8 costs module by module, and write a recipe within a"
            " limit."
        ),
        "search": "Find the scheme within the budgets that costs the plan least.",
    },
    "Compare and measure": {
        "compare": (
            "Run two graphs over frames: SQNR of every output, plan displacement in"
            " metres."
        ),
        "profile": (
            "Measure a model alone and warm, and write its latencies as a trace."
        ),
    },
    "Drive": {
        "evaluate": "Drive a policy over routes of highway-env; run it again to go on.",
        "score": (
            "Print driving score, success rate, efficiency, comfort and abilities."
        ),
        "study": (
            "Drive variants under conditions and compare them; run it again to go on."
        ),
        "routes": (
            "Make a fresh set of admitted routes, or examine an existing set again."
        ),
    },
}
"""Commands with their first line of help, by the panel that lists them."""
_DRIVING = ("evaluate", "study", "routes")
"""Commands that need the extra ``highway``."""

COMMANDS = {
    name: CommandEntry(panel, name, line, "highway" if name in _DRIVING else "")
    for panel, lines in _PANELS.items()
    for name, line in lines.items()
}
"""Commands in the order in which ``--help`` lists them."""


class LazyGroup(TyperGroup):
    """A group whose commands are only names and help until one is called."""

    def resolve_command(
        self, ctx: Any, args: list[str]
    ) -> tuple[str | None, Any, list[str]]:
        """Import the command that the first word names."""
        name, known, rest = super().resolve_command(ctx, args)
        if name is None:
            return name, known, rest
        # only the command that is called is imported
        loaded = COMMANDS[name].load()
        taken = {flag for each in loaded.params for flag in each.opts}
        for flag in (word.partition("=")[0] for word in rest):
            gone = FORMER.get(f"{name} {flag}") or FORMER.get(flag)
            if gone and flag not in taken:
                ctx.fail(gone)
        common = [each for each in self.params if each.name in COMMON]
        loaded.params = [*loaded.params, *common]  # before and after the command's name
        return name, loaded, rest


def build_app() -> typer.Typer:
    """Build the application: every command as a name and a line of help."""
    made = _app(add_completion=True)
    made.callback(no_args_is_help=True)(_options)
    for entry in COMMANDS.values():
        line, panel = entry.line(), entry.panel
        made.command(entry.name, help=line, rich_help_panel=panel)(_not_imported)
    return made


def _app(*, add_completion: bool = False) -> typer.Typer:
    return typer.Typer(
        cls=LazyGroup,
        name="me2e-compress",
        add_completion=add_completion,
        pretty_exceptions_enable=False,
    )


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"me2e-compress {__version__}")
        raise typer.Exit


def _printing(*flags: str, help: str, wanted: Verbosity) -> Any:
    """Return an option that sets how much is printed."""

    def callback(given: bool) -> None:
        if given:
            set_verbosity(wanted)

    return typer.Option(*flags, help=help, callback=callback, expose_value=False)


Version = Annotated[
    bool,
    typer.Option(
        "--version", help="print the version", callback=_show_version, is_eager=True
    ),
]
Quiet = Annotated[
    bool,
    _printing("-q", "--quiet", help="only results and errors", wanted=Verbosity.QUIET),
]
_NOTES = "notes and node lists too"
Verbose = Annotated[
    bool, _printing("-v", "--verbose", help=_NOTES, wanted=Verbosity.VERBOSE)
]
COMMON = ("quiet", "verbose", "json")
"""Options that stand before or after the name of a command."""


def _options(
    version: Version = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    json: given.Json = False,
) -> None:
    """Make modular end-to-end driving models small, and prove that they drive."""


def _not_imported() -> None:
    """Stand in for a command in the list of commands."""


app = build_app()
