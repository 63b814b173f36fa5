"""Which module of the stack the code that runs now belongs to.

The forward passes of the zoo say ``with region("motion"):`` around their parts. Outside
of a recording this does nothing; `me2e_compress.zoo.truth` listens to it.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar

Listener = Callable[[str], AbstractContextManager[None]]

_listener: ContextVar[Listener | None] = ContextVar("region_listener", default=None)


@contextmanager
def region(module: str) -> Iterator[None]:
    """Mark what runs inside as part of a module; a no-op unless someone listens."""
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
