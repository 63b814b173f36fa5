"""UniAD at its published sizes, one runtime a process: minutes, and 8 GB."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from me2e_compress.zoo.uniad.config import CONFIGS


@pytest.mark.slow
@pytest.mark.parametrize("stack", CONFIGS)
def test_onnxruntime_agrees_with_torch(stack: str, tmp_path: Path) -> None:
    command = ["-m", "benchmarks.bench_uniad", str(tmp_path), "--stack", stack]
    done = subprocess.run(
        [sys.executable, *command], check=True, text=True, stdout=subprocess.PIPE
    )
    exported, *_, errors = done.stdout.splitlines()
    assert json.loads(exported.removeprefix("export: "))["peak_gb"] < 8
    assert max(frame["error"] for frame in json.loads(errors)) < 1e-4
