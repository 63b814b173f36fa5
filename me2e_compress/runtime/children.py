"""Child processes: none runs code of the current folder, none outlives its parent.

Every process of this package is started here, or within :func:`sheltered`.
"""

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import active_children, parent_process, resource_tracker
from multiprocessing.context import SpawnContext, SpawnProcess
from pathlib import Path

from me2e_compress.runtime import child_main

_TRACKER_IS_SILENT = "ignore::UserWarning:multiprocessing.resource_tracker"
"""It clears locks away where this process was killed, and need not say so."""
_STARTING = threading.RLock()


@contextlib.contextmanager
def sheltered() -> Iterator[None]:
    """Start processes in this block so that they hear no Ctrl-C and look around less.

    Python looks for the modules of a new process in the current folder first, be it
    ``pickle`` or ``numpy``. And a terminal sends Ctrl-C to all processes at once: only
    the parent shall hear it, and ends the others.
    """
    with _STARTING, _told("PYTHONSAFEPATH", "1"):
        if os.name == "posix":
            with _told("PYTHONWARNINGS", _TRACKER_IS_SILENT):
                resource_tracker.ensure_running()  # else a lock starts it unsheltered
        with _deaf_to_interrupts():
            yield


@contextlib.contextmanager
def _told(name: str, value: str) -> Iterator[None]:
    """Set a variable of the environment, for the processes that start meanwhile."""
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


@contextlib.contextmanager
def _deaf_to_interrupts() -> Iterator[None]:
    """Block Ctrl-C in this thread: processes that it starts inherit that."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class ShelteredProcess(SpawnProcess):
    """A spawned process that starts within :func:`sheltered`."""

    def start(self) -> None:
        """Start it."""
        with sheltered():
            super().start()


class ShelteredContext(SpawnContext):
    """The context ``spawn``, its processes sheltered."""

    Process = ShelteredProcess


def spawn_context() -> ShelteredContext:
    """Return the context that every process is started from."""
    with sheltered():  # starts what watches over the context's locks
        return ShelteredContext()


def end_with_parent() -> None:
    """End this spawned process when its parent does; leave Ctrl-C to the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is None:
        return

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


@contextlib.contextmanager
def killed_on_error() -> Iterator[None]:
    """Kill the processes that were started in this block if an error leaves it."""
    others = set(active_children())
    try:
        yield
    except BaseException:
        for each in set(active_children()) - others:
            each.kill()
        raise


@contextlib.contextmanager
def pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Open a pool of processes, which ends with this block, however it is left."""
    made = ProcessPoolExecutor(workers, spawn_context(), end_with_parent)
    try:
        with killed_on_error():
            yield made
    finally:
        made.shutdown(cancel_futures=True)


def run_script(
    script: Path, words: Sequence[str], timeout_s: float | None = None
) -> "subprocess.CompletedProcess[str]":
    """Run a Python file, which imports nothing of this package, to its end.

    Args:
        script: the file.
        words: its arguments.
        timeout_s: seconds that it may take; None for any.

    Returns:
        Its exit code, and what it wrote.

    Raises:
        subprocess.TimeoutExpired: it took longer, and was killed.
    """
    command = [sys.executable, "-P", child_main.__file__, str(script), *words]
    ear, mouth = os.pipe()  # nothing is ever said: it ends when this process does
    try:
        return subprocess.run(
            command,
            check=False,
            stdin=ear,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout_s,
        )
    finally:
        os.close(ear)
        os.close(mouth)
