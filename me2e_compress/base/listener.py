"""Callbacks of a long step: progress and warnings."""

import dataclasses
from collections.abc import Callable


def _ignore(*words: object) -> None:
    """Show nothing."""


@dataclasses.dataclass(frozen=True)
class Listener:
    """Functions that are called during a long step; neither changes its result.

    Attributes:
        on_progress: gets the stage, things done, things in all, and words.
        on_warning: gets one line per surprise.
    """

    on_progress: Callable[[str, int, int, str], None] = dataclasses.field(
        default_factory=lambda: _ignore, repr=False
    )
    on_warning: Callable[[str], None] = dataclasses.field(
        default_factory=lambda: _ignore, repr=False
    )

    def counting(self, stage: str, words: str = "") -> Callable[[int, int], None]:
        """Return a function of things done, and in all, that reports a stage."""
        return lambda done, total: self.on_progress(stage, done, total, words)


SILENT = Listener()
