"""Make Ctrl-C and SIGTERM end a command in order, and soon, whatever it is doing."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from types import FrameType

# Exit codes after Ctrl-C and after SIGTERM, as shells count them
INTERRUPTED, TERMINATED = 128 + signal.SIGINT, 128 + signal.SIGTERM
# Seconds that native code may delay a signal; after that the process ends
TIMEOUT_S = 5.0
# The signal for which a handler raises each exception
_SIGNALS: dict[type[BaseException], signal.Signals] = {
    KeyboardInterrupt: signal.SIGINT,
    SystemExit: signal.SIGTERM,
}
_MOMENT_S = 0.02


@contextlib.contextmanager
def handle_signals() -> Iterator[None]:
    """Make SIGTERM an exit like Ctrl-C, so that processes and drafts are cleaned up.

    An exception raised in a finalizer, or in a callback of native code, is lost; Python
    reports it to `sys.unraisablehook`, and the signal is sent again a moment later.
    Native code that never returns, such as an endless loop in a graph, blocks the
    handler: the process then exits all the same, and leaves what a kill leaves.
    """
    handled = threading.Event()

    def on_signal(number: int, frame: FrameType | None) -> None:
        handled.set()
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(TERMINATED)

    def on_lost(lost: "sys.UnraisableHookArgs") -> None:
        number = _SIGNALS.get(lost.exc_type)
        if number is None:
            hook(lost)
        else:
            threading.Timer(_MOMENT_S, os.kill, (os.getpid(), number)).start()

    # install the handlers and the hook for lost exceptions
    hook, sys.unraisablehook = sys.unraisablehook, on_lost
    before = {signal.SIGTERM: signal.signal(signal.SIGTERM, on_signal)}
    # what is started in the background ignores Ctrl-C, and goes on doing so
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        before[signal.SIGINT] = signal.signal(signal.SIGINT, on_signal)
    try:
        with _exit_if_unhandled(handled):
            yield
    finally:
        # restore what was there before
        for number, handler in before.items():
            signal.signal(number, handler)
        sys.unraisablehook = hook


@contextlib.contextmanager
def _exit_if_unhandled(handled: threading.Event) -> Iterator[None]:
    """Exit if a signal is not handled within `TIMEOUT_S`."""
    # Python writes signal numbers into a pipe even while native code runs
    reader, writer = os.pipe()
    os.set_blocking(writer, False)

    def watch() -> None:
        while number := os.read(reader, 1):
            wanted = number[0] in (signal.SIGINT, signal.SIGTERM)
            if wanted and not handled.wait(TIMEOUT_S):
                os.write(2, b"me2e-compress: interrupted\n")
                os._exit(128 + number[0])

    # a thread watches the pipe until it is closed
    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    before = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        os.close(writer)
        thread.join()
        os.close(reader)
