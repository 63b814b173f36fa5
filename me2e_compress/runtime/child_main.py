"""Run a script and end with the parent: ``python -P child_main.py SCRIPT WORDS``.

It imports nothing of the package: the script shall start at once.
"""

import os
import runpy
import sys
import threading

PR_SET_PDEATHSIG = 1
"""Of prctl(2): a signal of one's own for the end of the parent."""
SIGKILL = 9


def main() -> None:
    """Watch the parent, run the script."""
    if sys.platform == "linux":  # native code that holds Python's lock ends, too
        import ctypes

        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, SIGKILL)
    threading.Thread(target=_wait_for_parent, daemon=True).start()
    del sys.argv[0]
    runpy.run_path(sys.argv[0], run_name="__main__")


def _wait_for_parent() -> None:
    """End this process when its input does, which the parent holds open."""
    while os.read(0, 1):
        pass
    os._exit(1)


if __name__ == "__main__":
    main()
