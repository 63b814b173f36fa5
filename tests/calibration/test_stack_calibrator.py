"""All files of a stack are calibrated in one pass of the whole."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from me2e_compress import graph
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.part_frames import PartFrames
from me2e_compress.calibration.stack_calibrator import StackCalibrator
from me2e_compress.errors import FramesError
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.session import Session
from me2e_compress.runtime.stack.split_stack import SplitStack
from tests.frames import record
from tests.stacks import THREE_FILES, dense_frames, write_dense

TENSORS = {
    "head": ("next_bev", "far"),
    "head.first_frame": ("far",),
    "backbone": ("a",),
}


@pytest.mark.parametrize("method", ["max-min", "entropy"])
def test_ranges_are_those_of_each_file_alone(tmp_path: Path, method: str) -> None:
    stack = SplitStack.load(write_dense(tmp_path, THREE_FILES))
    frames = CalibrationSet(dense_frames(tmp_path))
    models = {name: graph.load(each.path) for name, each in stack.files.items()}

    found = StackCalibrator(method).run(stack, models, TENSORS, frames)

    assert found == {
        name: Calibrator(method).run(
            models[name], names, PartFrames(stack, name, frames)
        )
        for name, names in TENSORS.items()
    }


def test_what_is_not_a_number_is_found_in_its_frame(tmp_path: Path) -> None:
    image = np.zeros((4, 16), np.float32)
    frames = [{"img": image}, {"img": np.where(np.eye(4, 16) > 0, np.nan, image)}]
    stack = SplitStack.load(write_dense(tmp_path))
    models = {name: graph.load(each.path) for name, each in stack.files.items()}

    with pytest.raises(FramesError, match="frame 1 makes tensor a NaN"):
        StackCalibrator().run(
            stack,
            models,
            {"head": (), "backbone": ("a",)},
            CalibrationSet(record(tmp_path / "frames", frames)),
        )


def test_every_file_runs_once_a_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stack = SplitStack.load(write_dense(tmp_path))
    frames = CalibrationSet(dense_frames(tmp_path))
    models = {name: graph.load(each.path) for name, each in stack.files.items()}
    run, runs = Session.run, list[object]()

    def counted(self: Session, *given: Any, **named: Any) -> dict[str, Array]:
        runs.append(self)
        return run(self, *given, **named)

    monkeypatch.setattr(Session, "run", counted)
    StackCalibrator().run(stack, models, {"head": ("far",), "backbone": ()}, frames)

    assert len(runs) == len(models) * len(frames)
