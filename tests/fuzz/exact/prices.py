"""Dear work: prices under which passes rewrite even the small graphs that are drawn.

A product moves only where that pays, and in a graph of a few rows it seldom does. What
a rewrite computes must not depend on its price, so here work counts a thousandfold.
"""

import contextlib
import sys
from collections.abc import Iterator
from types import ModuleType

from me2e_compress.passes import hoist_linear, work

PREFIX = "dear work: "
"""What a pipeline begins with that is run under these prices."""

NAMES = ("MACS_PER_NODE", "MOVED_BYTES_PER_NODE")
FACTOR = 1000


def _holders() -> Iterator[ModuleType]:
    """Find the modules that took the prices over by name."""
    within = f"{hoist_linear.__name__}."
    for name, module in list(sys.modules.items()):
        if name == work.__name__ or name.startswith(within):
            yield module


@contextlib.contextmanager
def dear_work() -> Iterator[None]:
    """Let work count a thousandfold for a while."""
    before = [
        (module, name, getattr(module, name))
        for module in _holders()
        for name in NAMES
        if hasattr(module, name)
    ]
    assert before
    try:
        for module, name, price in before:
            setattr(module, name, price / FACTOR)
        yield
    finally:
        for module, name, price in before:
            setattr(module, name, price)
