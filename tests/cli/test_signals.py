"""Real signals to real processes: nothing half-written, and the same run works again.

The commands take seconds each: these tests are slow. What a kill leaves at any write
is in test_kills.
"""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.cli.test_kills import COMMANDS, check_whole, contents

START = "import sys; from me2e_compress.cli import main; sys.exit(main())"


def started(folder: Path, words: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-P", "-c", START, *words.split()],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.slow
@pytest.mark.parametrize("after_s", [1.0, 2.0, 3.0])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
@pytest.mark.parametrize("words", COMMANDS.values(), ids=COMMANDS)
def test_a_signal_at_any_time_leaves_what_was_there(
    dense: Path, words: str, number: signal.Signals, after_s: float
) -> None:
    before = contents(dense)
    process = started(dense, words)
    time.sleep(after_s)
    process.send_signal(number)
    _, said = process.communicate(timeout=60)

    if process.returncode == 128 + number:
        assert "Traceback" not in said
    check_whole(dense)
    after = contents(dense)
    assert {name: after[name] for name in before} == before
    with started(dense, words) as again:
        _, said = again.communicate(timeout=120)
        assert again.returncode == 0, said
