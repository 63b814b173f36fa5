"""Measurements in processes of their own, and works timed in turn in this one."""

import json
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any


def answer(command: Sequence[str | Path]) -> dict[str, Any] | str:
    """Run a command whose last line is JSON; return that, or why there is none."""
    done = subprocess.run(
        [str(word) for word in command], capture_output=True, text=True, check=False
    )
    if done.returncode:
        return last_line(done)
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def last_line(done: "subprocess.CompletedProcess[str]") -> str:
    """Say why a child ended without what it was started for."""
    lines = done.stderr.strip().splitlines() or [f"exit {done.returncode}"]
    return lines[-1][:160]


def has_modelopt(python: Path) -> bool:
    """Return whether ModelOpt is installed for an interpreter."""
    probe = [str(python), "-W", "ignore", "-c", "import modelopt.onnx.quantization"]
    return subprocess.run(probe, capture_output=True, check=False).returncode == 0


def in_turn(
    works: Mapping[str, Callable[[], object]],
    rounds: int,
    clock: Callable[[], float] = time.process_time,
) -> dict[str, list[float]]:
    """Run works in turn, once uncounted; return seconds by name.

    They are those of all threads together, unless another clock is given.
    """
    taken: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(rounds + 1):
        for name, work in works.items():
            begun = clock()
            work()
            taken[name].append(clock() - begun)
    return {name: seconds[1:] for name, seconds in taken.items()}
