"""UniAD at its published size: what a run that goes on computes again."""

import argparse
from pathlib import Path

import numpy as np
import pytest

from benchmarks import bench_uniad
from models.stacks import UNIAD_TINY


class Counting:
    """A runtime that says how many frames it has run."""

    def __init__(self) -> None:
        self.runs = 0

    def __call__(self, feeds: bench_uniad.Outputs) -> bench_uniad.Outputs:
        self.runs += 1
        seen = np.float32(feeds["timestamp"].item())
        return dict.fromkeys(UNIAD_TINY.outputs, np.array([seen]))


@pytest.fixture
def frames(monkeypatch: pytest.MonkeyPatch) -> None:
    def numbered(_: object, count: int) -> list[bench_uniad.Outputs]:
        return [{"timestamp": np.array([each + 1.0])} for each in range(count)]

    monkeypatch.setattr(bench_uniad, "_frames", numbered)


def drive(out: Path, frames: int, runtime: str, *, resume: bool) -> int:
    given = argparse.Namespace(
        out=out, frames=frames, resume=resume, stack=UNIAD_TINY.name
    )
    counting = Counting()
    bench_uniad.drive(given, runtime, counting)
    return counting.runs


@pytest.mark.usefixtures("frames")
def test_frames_that_are_there_are_kept_on_request_alone(tmp_path: Path) -> None:
    assert drive(tmp_path, 2, "torch", resume=True) == 2
    assert drive(tmp_path, 5, "torch", resume=True) == 3
    assert drive(tmp_path, 5, "torch", resume=False) == 5


@pytest.mark.usefixtures("frames")
def test_frames_are_compared_as_far_as_both_have_run(tmp_path: Path) -> None:
    drive(tmp_path, 2, "torch", resume=True)
    drive(tmp_path, 3, "onnxruntime", resume=True)
    said = bench_uniad.errors_of(tmp_path, UNIAD_TINY, 3)
    assert [(each["frame"], each["error"]) for each in said] == [(0, 0.0), (1, 0.0)]
