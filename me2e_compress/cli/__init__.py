"""The ``me2e-compress`` command; the only package that prints."""

import os
import sys
from collections.abc import Callable
from pathlib import Path

from me2e_compress.base.display import escape_controls
from me2e_compress.base.errors import Me2eError, OptionError
from me2e_compress.cli.signals import INTERRUPTED, TERMINATED, handle_signals

RUN_AGAIN = "run again to go on"
# What to do to resume a command that was interrupted
RESUMES = {
    **dict.fromkeys(("calibrate", "evaluate", "sensitivity", "study"), RUN_AGAIN),
    "frames": f"{RUN_AGAIN} after the last whole scene, if there is one",
}


def main() -> int:
    """Run the command and return its exit code."""
    words = [word for word in sys.argv[1:] if not word.startswith("-")]
    hints = [RESUMES[word] for word in words[:1] if word in RESUMES]
    return run_command(_commands, *hints)


def run_command(run: Callable[[], None], resume_hint: str = "") -> int:
    """Run a command that reads ``sys.argv``; return its exit code.

    Our own errors are one line and code 1; the hint is printed after a signal.
    """
    try:
        with handle_signals():
            code = _run(run)
    except SystemExit as done:
        code = done.code if isinstance(done.code, int) else int(bool(done.code))
    except KeyboardInterrupt:
        code = INTERRUPTED
    if code in (INTERRUPTED, TERMINATED):
        message = "; ".join(filter(None, ["interrupted", resume_hint]))
        sys.stderr.write(f"me2e-compress: {message}\n")
    return code


def _commands() -> None:
    # not imported above: processes that evaluate spawns import this module, not these
    from me2e_compress.cli.app import app

    app.meta(sys.argv[1:])


def _run(run: Callable[[], None]) -> int:
    """Run a command; print an error of the user's on one line; return the exit code."""
    from cyclopts import CycloptsError

    from me2e_compress.base.extras import with_install_hint
    from me2e_compress.cli.console import errors

    try:
        # file names that are not UTF-8, and a current folder that was removed
        try:
            Path.cwd()
        except OSError as error:
            raise Me2eError(f"the current folder: {error.strerror}") from error
        for word in sys.argv[1:]:
            if any("\ud800" <= letter <= "\udfff" for letter in word):
                raise Me2eError(f"{word!a} is not UTF-8: rename the file")
        run()
    except (CycloptsError, Me2eError, OSError, ImportError) as error:
        hint = with_install_hint(error)
        if isinstance(hint, ImportError):
            raise  # of no optional package: a defect of ours, which needs its traceback
        # an error of the user's is one line, without a traceback; that of the system
        # is preceded by its file, if any
        text = str(hint)
        if isinstance(hint, OSError) and hint.filename is not None and hint.strerror:
            text = f"{os.fsdecode(hint.filename)}: {hint.strerror}"
        line = escape_controls(" ".join(text.split()))
        errors.print(f"me2e-compress: {line}", soft_wrap=True, markup=False)
        usage = isinstance(error, CycloptsError | OptionError)
        return 2 if usage else 1
    return 0
