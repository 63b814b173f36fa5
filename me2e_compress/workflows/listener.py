"""How a workflow reports progress: to nobody, unless a listener is given."""

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Listener:
    """Functions that are called while a workflow runs; neither changes it.

    Args:
        on_progress: Called with the stage, things done and to do, and words.
        on_warning: Called with one line a surprise.
    """

    on_progress: Callable[[str, int, int, str], None] = lambda stage, a, b, words: None
    on_warning: Callable[[str], None] = lambda line: None


SILENT = Listener()
