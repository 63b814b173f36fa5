"""How a workflow reports progress: to nobody, unless a listener is given."""

from collections.abc import Callable
from dataclasses import dataclass, field

Progress = Callable[[str, int, int, str], None]
Warn = Callable[[str], None]


@dataclass(frozen=True)
class Listener:
    """Functions that are called while a workflow runs; neither changes its result.

    Attributes:
        on_progress: gets the stage, things done, things in all, and words.
        on_warning: gets one line per surprise.
    """

    on_progress: Progress = field(default_factory=lambda: _no_progress, repr=False)
    on_warning: Warn = field(default_factory=lambda: _no_warning, repr=False)


def _no_progress(stage: str, done: int, total: int, words: str) -> None:
    """Say nothing."""


def _no_warning(line: str) -> None:
    """Say nothing."""


SILENT = Listener()
