"""What is printed, set by the options ``-q``, ``-v`` and ``--json``."""

import enum

import typer


class Verbosity(enum.Enum):
    """How much is printed besides results and errors."""

    QUIET = enum.auto()
    NORMAL = enum.auto()
    VERBOSE = enum.auto()


_chosen = Verbosity.NORMAL
_as_json = False


def set_verbosity(wanted: Verbosity) -> None:
    """Set how much is printed, until the next call."""
    global _chosen
    _chosen = wanted


def set_json(context: typer.Context, wanted: bool) -> None:
    """Set whether results are printed as JSON, until the next call.

    The option stands before or after the name of a command.
    """
    global _as_json
    if wanted or context.parent is None:
        _as_json = wanted


def is_json() -> bool:
    """Return whether a result is printed as one JSON document."""
    return _as_json


def is_quiet() -> bool:
    """Return whether only results and errors are printed."""
    return _chosen is Verbosity.QUIET


def is_verbose() -> bool:
    """Return whether notes and node lists are printed too."""
    return _chosen is Verbosity.VERBOSE
