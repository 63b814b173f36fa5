"""All files of a stack are calibrated in one pass of the whole."""

from pathlib import Path

import pytest

import me2e_compress as me2e
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.errors import FramesError, GraphError, PreconditionError
from tests.cli.conftest import Command, strict
from tests.docs.documents import faults
from tests.stacks import THREE_FILES, dense_frames, write_dense


def test_compress_takes_the_folder(
    tmp_path: Path, command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    stack, frames = write_dense(tmp_path, THREE_FILES), dense_frames(tmp_path)
    ranges = tmp_path / "ranges"

    assert command("calibrate", stack, frames, "-o", ranges, "--json") == 0

    assert faults("calibrate", strict(capsys.readouterr().out)) == []
    assert Ranges.load(ranges / "head.first_frame.json").frames == 4
    assert Ranges.load(ranges / "head.json").frames == 4
    assert Ranges.load(ranges / "backbone.json").frames == 8
    options = me2e.CompressOptions(ranges=ranges, verify_frames=0)
    small = me2e.compress_stack(stack, tmp_path / "small", "full", frames, options)
    assert all(each.int8 and each.int8.nodes for each in small.files.values())


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (me2e.CalibrateOptions(merge=("a.npz",)), "--merge is for one file"),
        (me2e.CalibrateOptions(imported="a.cache"), "--import is for one file"),
    ],
)
def test_what_is_for_one_file_is_refused(
    tmp_path: Path, options: me2e.CalibrateOptions, said: str
) -> None:
    with pytest.raises(FramesError, match=said):
        me2e.calibrate_stack(write_dense(tmp_path), None, tmp_path / "r", options)


def test_ranges_of_a_stack_are_a_folder(tmp_path: Path) -> None:
    with pytest.raises(GraphError, match="a folder is written: name one"):
        me2e.calibrate_stack(
            write_dense(tmp_path), dense_frames(tmp_path), tmp_path / "r.json"
        )


def test_a_stack_that_is_quantized_is_refused(tmp_path: Path) -> None:
    stack, frames = write_dense(tmp_path), dense_frames(tmp_path)
    small = me2e.compress_stack(
        *(stack, tmp_path / "small", "full", frames),
        me2e.CompressOptions(verify_frames=0, measure_frames=0),
    )

    with pytest.raises(PreconditionError, match=r"head\.onnx: .* quantized already"):
        me2e.calibrate_stack(small.output, frames, tmp_path / "ranges")
