"""Mark which module of the stack the running code belongs to.

The forward passes wrap their parts in ``with region("motion"):``. This does
nothing except in a recording: `models.tests.truth` listens to it.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar

Listener = Callable[[str], AbstractContextManager[None]]

_listener: ContextVar[Listener | None] = ContextVar("region_listener", default=None)


@contextmanager
def region(module: str) -> Iterator[None]:
    """Mark the block as part of a module; a no-op unless someone listens."""
    listener = _listener.get()
    if listener is None:
        yield
        return
    with listener(module):
        yield


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Enter ``listener(module)`` at every region until the block ends."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)
