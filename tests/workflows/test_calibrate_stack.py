"""A stack is calibrated as one graph, and its files for first frames beside it."""

from pathlib import Path

import numpy as np
import pytest

import me2e_compress as me2e
from me2e_compress import graph
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.calibration.stack_frames import StackFrames, recording_of
from me2e_compress.errors import FramesError, PreconditionError
from me2e_compress.runtime.session import replay
from me2e_compress.runtime.stack_session import open_session
from tests.command import Command, command, strict
from tests.docs.documents import faults
from tests.frames import record
from tests.stacks import THREE_FILES, TWO_PARTS, dense_frames, write_dense, write_stack

__all__ = ["command"]

Seen = list[tuple[int, bool, dict[str, float]]]


def seen(frames: StackFrames) -> Seen:
    return [
        (
            each.index,
            each.starts_scene,
            {name: float(array[0, 0]) for name, array in each.arrays.items()},
        )
        for each in frames
    ]


def fed(folder: Path, toml: str, scenes: tuple[int, ...] = (0, 3)) -> StackFrames:
    """Return how a stack is fed over five frames of ones."""
    path, image = write_stack(folder, toml), np.ones((1, 4), np.float32)
    recorded = record(folder / "frames", [{"img": image}] * 5, scenes)
    found = recording_of(graph.LoadedModel.load(path), recorded)
    assert isinstance(found, StackFrames)
    return found


def test_first_values_come_with_the_frames(tmp_path: Path) -> None:
    toml = TWO_PARTS + '[state]\nprev_bev = {first = "head.learned"}\n'

    frames = fed(tmp_path, toml)

    assert seen(frames)[0] == (0, True, {"prev_bev": 1.0, "img": 1.0})
    assert frames.fingerprint == me2e.CalibrationSet(frames.folder).fingerprint


def test_scenes_begin_behind_the_files_for_first_frames(tmp_path: Path) -> None:
    assert seen(fed(tmp_path, THREE_FILES)) == [
        (0, True, {"img": 1.0, "prev_bev": 20.0}),
        (1, False, {"img": 1.0}),
        (2, True, {"img": 1.0, "prev_bev": 20.0}),
    ]


def test_the_file_for_first_frames_sees_those_alone(tmp_path: Path) -> None:
    frames = fed(tmp_path, THREE_FILES)
    stack = graph.JoinedStack.load(tmp_path / "stack.toml")
    (file,) = stack.first_files.values()

    assert seen(frames.of_file(file)) == [
        *((0, True, {"feats": 2.0}), (1, True, {"feats": 2.0}))
    ]


def test_a_graph_that_never_runs_has_no_frames(tmp_path: Path) -> None:
    with pytest.raises(FramesError, match=r"stack\.toml: runs at none of 5 frames"):
        fed(tmp_path, THREE_FILES, (0, 1, 2, 3, 4))


@pytest.mark.parametrize("method", ["max-min", "percentile"])
def test_compress_takes_the_ranges(
    tmp_path: Path, command: Command, capsys: pytest.CaptureFixture[str], method: str
) -> None:
    stack, frames = write_dense(tmp_path, THREE_FILES), dense_frames(tmp_path)
    ranges = tmp_path / "ranges.json"
    words = ("calibrate", stack, frames, "-o", ranges, "--method", method, "--json")

    assert command(*words) == 0

    found = strict(capsys.readouterr().out)
    assert faults("calibrate", found) == []
    first = Ranges.load(tmp_path / "ranges.head.first_frame.json")
    assert (Ranges.load(ranges).frames, first.frames) == (4, 4)
    options = me2e.CompressOptions(ranges=ranges, method=method, verify_frames=0)
    small = me2e.compress(stack, tmp_path / "small", "full", frames, options)
    assert small.int8 is not None
    assert small.int8.nodes == 2
    first_int8 = small.first_frames["head.first_frame"].int8
    assert first_int8 is not None
    assert first_int8.nodes == 1


def test_ranges_hold_what_the_running_stack_has(tmp_path: Path) -> None:
    stack, frames = write_dense(tmp_path, THREE_FILES), dense_frames(tmp_path)

    options = me2e.CalibrateOptions(method="max-min")
    found = me2e.calibrate(stack, frames, tmp_path / "ranges.json", options).ranges

    session = open_session(stack, threads=1)
    recording = me2e.CalibrationSet(frames)
    bevs = [each["next_bev"] for each in replay(session, recording, ["next_bev"])]
    assert found is not None
    low, high = found.tensors["next_bev"]
    later = np.stack(bevs[1::2])  # scenes of two: the other file runs at the first
    assert (low, high) == pytest.approx((later.min(), later.max()), rel=1e-5)


@pytest.mark.parametrize(
    "options",
    [me2e.CalibrateOptions(merge=("a.npz",)), me2e.CalibrateOptions(imported="a")],
)
def test_what_is_for_one_graph_is_refused(
    tmp_path: Path, options: me2e.CalibrateOptions
) -> None:
    stack = write_dense(tmp_path, THREE_FILES)

    with pytest.raises(FramesError, match=r"head\.first_frame runs where a scene beg"):
        me2e.calibrate(stack, None, tmp_path / "r.json", options)


def test_a_stack_that_is_quantized_is_refused(tmp_path: Path) -> None:
    stack, frames = write_dense(tmp_path), dense_frames(tmp_path)
    small = me2e.compress(
        *(stack, tmp_path / "small", "full", frames),
        me2e.CompressOptions(verify_frames=0, measure_frames=0),
    )

    with pytest.raises(PreconditionError, match=r"stack\.toml: .* quantized already"):
        me2e.calibrate(small.output, frames, tmp_path / "ranges.json")
