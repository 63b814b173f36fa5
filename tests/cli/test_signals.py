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
TRAIN = "train -o course --small --workers 2"


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


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_training_that_a_signal_ends_says_nothing_of_the_interpreter(
    tmp_path: Path, number: signal.Signals
) -> None:
    pytest.importorskip("torch")
    process = started(tmp_path, TRAIN)
    time.sleep(15)
    process.send_signal(number)
    _, said = process.communicate(timeout=60)
    assert "Traceback" not in said
    assert "Warning" not in said
    assert not list(tmp_path.rglob("*.part"))
