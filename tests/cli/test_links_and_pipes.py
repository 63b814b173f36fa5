"""Links, pipes and folders of the user: nothing is written through, or removed."""

import contextlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.recording import write_recording
from me2e_compress.errors import FramesError, GraphError
from me2e_compress.runtime.frames import Frame
from me2e_compress.zoo.state_dict import read_state_dict
from tests.cli.conftest import Command

EXACT = ("compress", "in.onnx", "-o", "out.onnx", "--passes", "import-normalize")
ONE = Frame(0, True, {"camera": np.zeros((1, 4), np.float32)})


@pytest.mark.parametrize("name", [".out.partial", ".out.partial.before"])
def test_recording_leaves_folders_that_it_did_not_make(
    tmp_path: Path, name: str
) -> None:
    mine = tmp_path / name
    mine.mkdir()
    (mine / "notes.txt").write_text("mine")
    (tmp_path / "out").mkdir()

    with contextlib.suppress(FramesError):
        write_recording(tmp_path / "out", lambda begin: [ONE], {})

    assert (mine / "notes.txt").read_text() == "mine"


def test_unfinished_frames_do_not_go_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / ".out.partial").symlink_to("mine")
    with pytest.raises(FramesError, match="partial is a link"):
        write_recording(tmp_path / "out", lambda begin: [ONE], {})
    assert list((tmp_path / "mine").iterdir()) == []


@pytest.mark.parametrize("step", ["replace", "unlink", "mkdir", "touch"])
def test_a_recording_goes_on_after_a_kill_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    frames = [Frame(at, True, ONE.arrays, place=at) for at in range(3)]
    left = list[Path]()

    def first(real: Callable[..., object]) -> Callable[..., object]:
        def call(*given: object, **options: object) -> object:
            copy = shutil.copytree(tmp_path / "here", tmp_path / str(len(left)))
            left.append(copy / "out")
            return real(*given, **options)

        return call

    def make(out: Path) -> None:
        write_recording(out, lambda begin: frames[begin.frame :], {})

    (tmp_path / "here").mkdir()
    with monkeypatch.context() as patch:
        place = os if step == "replace" else Path
        step_of = getattr(place, step)
        patch.setattr(place, step, first(step_of))
        make(tmp_path / "here" / "out")
    for out in left:
        make(out)
        assert len(CalibrationSet(out)) == 3
        assert not [each for each in out.iterdir() if "progress" in each.name]
        assert not (out.parent / ".out.partial").exists()


def test_a_pipe_among_frames_is_one_line(files: Path) -> None:
    os.mkfifo(files / "frames" / "000002.npz")
    with pytest.raises(FramesError, match=r"000002\.npz: not a regular file"):
        CalibrationSet(files / "frames")


@pytest.mark.parametrize("name", ["pipe", "/dev/zero"])
def test_weights_that_never_end_are_one_line(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(GraphError, match="not a regular file"):
        read_state_dict(tmp_path / name)


def test_links_in_a_circle_are_one_line(
    command: Command,
    files: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(files)
    (files / "out.onnx").symlink_to("other.onnx")
    (files / "other.onnx").symlink_to("out.onnx")

    assert command(*EXACT) == 1

    assert capsys.readouterr().err.startswith("me2e-compress: out.onnx is there")


def test_a_name_that_is_not_utf8_is_one_line_and_nothing_is_written(
    command: Command,
    files: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(files)
    before = sorted(files.iterdir())

    assert command(*EXACT[:3], os.fsdecode(b"\xff.onnx"), *EXACT[4:]) == 1

    said = "me2e-compress: '\\udcff.onnx' is not UTF-8: rename the file\n"
    assert capsys.readouterr().err == said
    assert sorted(files.iterdir()) == before


def test_a_current_folder_that_is_gone_is_one_line(
    command: Command,
    files: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (files / "gone").mkdir()
    monkeypatch.chdir(files / "gone")
    (files / "gone").rmdir()

    assert command("compress", files / "in.onnx", *EXACT[2:]) == 1

    said = "me2e-compress: the current folder: No such file or directory\n"
    assert capsys.readouterr().err == said
