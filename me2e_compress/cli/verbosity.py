"""The amount of output, set by the options ``-q`` and ``-v``."""

import enum


class Verbosity(enum.Enum):
    """How much is printed besides results and errors."""

    QUIET = enum.auto()
    NORMAL = enum.auto()
    VERBOSE = enum.auto()


_chosen = Verbosity.NORMAL


def set_verbosity(wanted: Verbosity) -> None:
    """Set how much is printed, until the next call."""
    global _chosen
    _chosen = wanted


def is_quiet() -> bool:
    """Return whether only results and errors are printed."""
    return _chosen is Verbosity.QUIET


def is_verbose() -> bool:
    """Return whether notes and node lists are printed too."""
    return _chosen is Verbosity.VERBOSE
