"""What one file of a stack is fed while the stack runs."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.part_frames import PartFrames
from me2e_compress.calibration.sample import hold_out
from me2e_compress.errors import FramesError
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.session import Session
from me2e_compress.runtime.stack.split_stack import SplitStack
from tests.frames import record
from tests.stacks import THREE_FILES, TWO_PARTS, write_stack

IMAGE = np.ones((1, 4), np.float32)


def fed(
    folder: Path, label: str, toml: str = TWO_PARTS, scenes: tuple[int, ...] = (0, 3)
) -> PartFrames:
    """Return what a file is fed over five frames of ones."""
    stack = SplitStack.load(write_stack(folder, toml))
    whole = record(folder / "frames", [{"img": IMAGE}] * 5, scenes)
    return PartFrames(stack, label, CalibrationSet(whole))


def seen(frames: PartFrames) -> list[tuple[int, bool, dict[str, float]]]:
    return [
        (
            each.index,
            each.starts_scene,
            {name: float(array[0, 0]) for name, array in each.arrays.items()},
        )
        for each in frames
    ]


def test_a_part_is_fed_what_the_others_give_and_the_state(tmp_path: Path) -> None:
    assert seen(fed(tmp_path, "head")) == [
        (0, True, {"feats": 2.0, "prev_bev": 0.0}),
        (1, False, {"feats": 2.0, "prev_bev": 2.0}),
        (2, False, {"feats": 2.0, "prev_bev": 3.0}),
        (3, True, {"feats": 2.0, "prev_bev": 0.0}),
        (4, False, {"feats": 2.0, "prev_bev": 2.0}),
    ]


def test_the_file_for_first_frames_sees_those_alone(tmp_path: Path) -> None:
    frames = fed(tmp_path, "head.first_frame", THREE_FILES)

    assert seen(frames) == [(0, True, {"feats": 2.0}), (3, True, {"feats": 2.0})]


def test_the_file_for_next_frames_sees_the_rest(tmp_path: Path) -> None:
    assert seen(fed(tmp_path, "head", THREE_FILES)) == [
        (1, True, {"feats": 2.0, "prev_bev": 20.0}),
        (2, False, {"feats": 2.0, "prev_bev": 12.0}),
        (4, True, {"feats": 2.0, "prev_bev": 20.0}),
    ]


def test_frames_are_the_same_in_any_order(tmp_path: Path) -> None:
    frames = fed(tmp_path, "head", THREE_FILES)
    in_order = seen(frames)

    backwards = [frames[at].arrays["prev_bev"][0, 0] for at in (2, 1, 0, 1)]

    assert backwards == [in_order[at][2]["prev_bev"] for at in (2, 1, 0, 1)]


def test_a_part_that_nobody_feeds_runs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = fed(tmp_path, "backbone")
    opened: list[Path] = []
    monkeypatch.setattr(Session, "__init__", lambda _, path, **__: opened.append(path))

    assert [each[2] for each in seen(frames)] == [{"img": 1.0}] * 5
    assert not opened


def test_frames_in_order_run_each_file_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames, runs = fed(tmp_path, "head"), list[object]()
    run = Session.run

    def counted(self: Session, *given: Any, **named: Any) -> dict[str, Array]:
        runs.append(self)
        return run(self, *given, **named)

    monkeypatch.setattr(Session, "run", counted)
    list(frames)

    assert len(runs) == 2 * len(frames)


def test_a_part_of_the_frames_is_fed_alike(tmp_path: Path) -> None:
    stack = SplitStack.load(write_stack(tmp_path))
    whole = CalibrationSet(record(tmp_path / "frames", [{"img": IMAGE}] * 5, (0, 3)))
    _, measured = hold_out(whole, 2)

    assert [each[0] for each in seen(PartFrames(stack, "head", measured))] == [3]


def test_a_file_that_never_runs_has_no_frames(tmp_path: Path) -> None:
    with pytest.raises(FramesError, match="head: runs at none of 5 frames"):
        fed(tmp_path, "head", THREE_FILES, (0, 1, 2, 3, 4))
