"""UniAD at its published sizes, one runtime a process: minutes, and 8 GB."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from models.uniad.config import CONFIGS

FRAMES = 10


@pytest.mark.slow
@pytest.mark.parametrize("stack", CONFIGS)
def test_onnxruntime_agrees_with_torch(stack: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "benchmarks.measure.uniad", str(tmp_path)]
    options = ["--stack", stack, "--frames", str(FRAMES)]
    done = subprocess.run(
        [*command, *options], check=True, text=True, stdout=subprocess.PIPE
    )
    exported, *_, errors = done.stdout.splitlines()
    assert json.loads(exported.removeprefix("export: "))["peak_gb"] < 8
    found = [frame["error"] for frame in json.loads(errors)]
    assert len(found) == FRAMES
    assert max(found) < 1e-4
    with np.load(tmp_path / f"torch-{FRAMES - 1}.npz") as last:
        lists = [name for name in last.files if last[name].size > 1]
        assert [name for name in lists if np.ptp(last[name]) == 0] == []
