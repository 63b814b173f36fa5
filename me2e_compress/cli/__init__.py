"""The ``me2e-compress`` command, one short file each; the only room that prints."""

import contextlib
import signal
import sys
from collections.abc import Iterator
from types import FrameType
from typing import NoReturn

from me2e_compress.display import printable
from me2e_compress.errors import Me2eError

INTERRUPTED, TERMINATED = 128 + signal.SIGINT, 128 + signal.SIGTERM
"""Exit codes after Ctrl-C and after SIGTERM, as shells count them."""
RESUMES = frozenset(
    {"calibrate", "evaluate", "frames", "sensitivity", "study", "train"}
)
"""Commands that go on where they were interrupted."""


def main() -> int:
    """Run the command and give its exit code; our own errors are one line and code 1.

    The commands are imported here, not above: the processes that ``evaluate`` spawns
    import this module again, and need none of them.
    """
    try:
        with _terminated_in_order():
            code = _run()
    except SystemExit as done:
        code = done.code if isinstance(done.code, int) else int(bool(done.code))
    except KeyboardInterrupt:
        code = INTERRUPTED
    if code in (INTERRUPTED, TERMINATED):
        words = [word for word in sys.argv[1:] if not word.startswith("-")]
        again = "; run again to go on" if RESUMES & set(words[:1]) else ""
        sys.stderr.write(f"me2e-compress: interrupted{again}\n")
    return code


def _run() -> int:
    from me2e_compress.cli.app import app
    from me2e_compress.cli.console import errors
    from me2e_compress.cli.verbosity import Verbosity, set_verbosity
    from me2e_compress.extras import explained

    set_verbosity(Verbosity.NORMAL)
    try:
        app(standalone_mode=True, prog_name="me2e-compress")
    except (Me2eError, OSError, ImportError) as error:
        told = explained(error)
        if isinstance(told, ImportError):
            raise  # of no optional package: a defect of ours, which needs its traceback
        line = printable(" ".join(str(told).split()))
        errors.print(f"me2e-compress: {line}", soft_wrap=True, markup=False)
        return 1
    return 0


@contextlib.contextmanager
def _terminated_in_order() -> Iterator[None]:
    """Make SIGTERM an exit like Ctrl-C: processes and drafts are cleared away."""

    def leave(number: int, frame: FrameType | None) -> NoReturn:
        raise SystemExit(TERMINATED)

    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
