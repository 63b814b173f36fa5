"""What docs/stacks.md shows is done."""

from pathlib import Path

import numpy as np
import pytest

import me2e_compress as me2e
from me2e_compress.driving.contract import Observation, Trajectory, checked
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.shipped.drivers import shipped
from me2e_compress.simulator.cameras import CameraRig
from tests.command import Command, command
from tests.docs.pages import ROOT, blocks
from tests.stacks import dense_frames, write_dense

__all__ = ["command"]

PAGE = ROOT / "docs" / "stacks.md"


def decided(model: Path) -> list[object]:
    """Return three plans of a driver from the start of a route."""
    policy, rig = OnnxPolicy.open(model), CameraRig(96, 160)
    policy.reset(None)
    random = np.random.default_rng(0)
    plans = list[object]()
    for step in range(3):
        seen = Observation(
            50_000 * step,
            random.integers(0, 256, (6, 96, 160, 3)).astype(np.uint8),
            rig.lidar2img,
            random.normal(size=18).astype(np.float32),
            2,
            5.0,
        )
        answer = checked(policy.plan(seen))
        assert isinstance(answer, Trajectory)
        plans.append(answer.points.tolist())
    return plans


def test_the_driver_of_the_page_decides_as_the_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (toml,), (script,) = blocks(PAGE, "toml"), blocks(PAGE, "python")
    Path("stack.toml").write_text(toml.text)
    exec(script.text, {})

    made = me2e.join("stack.toml", "whole.onnx")

    assert decided(made.output) == decided(shipped("highway"))


def test_the_commands_of_the_page_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    monkeypatch.chdir(tmp_path)
    write_dense(tmp_path)  # a smaller stack
    dense_frames(tmp_path)

    for line in "".join(each.text for each in blocks(PAGE, "sh")).splitlines():
        assert command(*line.split()[1:]) == 0, line
