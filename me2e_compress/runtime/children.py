"""Child processes, none of which runs code of the current folder.

Every process of this package is started here, or within :func:`sheltered`.
"""

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from multiprocessing import parent_process, resource_tracker
from multiprocessing.context import SpawnContext, SpawnProcess
from pathlib import Path

# Silences the warning about locks that the tracker cleans up after a kill
_TRACKER_IS_SILENT = "ignore::UserWarning:multiprocessing.resource_tracker"
_STARTING = threading.RLock()


@contextlib.contextmanager
def sheltered() -> Iterator[None]:
    """Start processes in this block without Ctrl-C and without the current folder."""
    # Python looks for the modules of a new process in the current folder first, even
    # for `pickle` or `numpy`
    with _STARTING, _with_environment("PYTHONSAFEPATH", "1"):
        if os.name == "posix":
            with _with_environment("PYTHONWARNINGS", _TRACKER_IS_SILENT):
                resource_tracker.ensure_running()  # else a lock starts it unsheltered
        if not hasattr(signal, "pthread_sigmask"):
            yield
            return
        # A terminal sends Ctrl-C to all processes at once: only the parent should get
        # it, and it ends the others. Processes inherit the mask of this thread
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _with_environment(name: str, value: str) -> Iterator[None]:
    """Set an environment variable for processes that start in this block."""
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


class ShelteredProcess(SpawnProcess):
    """A spawned process that starts within :func:`sheltered`."""

    def start(self) -> None:
        """Start the process within :func:`sheltered`."""
        with sheltered():
            super().start()


class ShelteredContext(SpawnContext):
    """The context ``spawn`` with sheltered processes."""

    Process = ShelteredProcess


def spawn_context() -> ShelteredContext:
    """Return the context from which every process is started."""
    with sheltered():  # starts what watches over the context's locks
        return ShelteredContext()


def end_with_parent() -> None:
    """Exit this spawned process when its parent exits; leave Ctrl-C to the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is None:
        return

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def run_script(
    script: Path, arguments: Sequence[str], timeout_s: float | None = None
) -> "subprocess.CompletedProcess[str]":
    """Run a Python file that imports nothing of this package; return what it wrote."""
    # What takes longer is killed, and raises TimeoutExpired
    return subprocess.run(
        [sys.executable, "-P", str(script), *arguments],
        check=False,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=timeout_s,
    )
