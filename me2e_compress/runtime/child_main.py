"""Run a script and exit with the parent: ``python -P child_main.py SCRIPT WORDS``.

It imports nothing of the package, so that the script starts at once.
"""

import os
import runpy
import sys
import threading

PR_SET_PDEATHSIG = 1
"""Option of prctl(2): the signal to receive when the parent dies."""
SIGKILL = 9


def main() -> None:
    """Watch the parent and run the script."""
    if sys.platform == "linux":  # native code that holds Python's lock ends, too
        import ctypes

        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, SIGKILL)
    threading.Thread(target=_wait_for_parent, daemon=True).start()
    del sys.argv[0]
    runpy.run_path(sys.argv[0], run_name="__main__")


def _wait_for_parent() -> None:
    """Exit when standard input closes; the parent holds it open."""
    while os.read(0, 1):
        pass
    os._exit(1)


if __name__ == "__main__":
    main()
