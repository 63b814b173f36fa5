"""No command writes over what it reads, or through links; none works before it can."""

import contextlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import FramesError, GraphError
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.recording import write_recording
from me2e_compress.graph import rewrite
from me2e_compress.runtime.frames import Frame
from models.state_dict import read_state_dict
from tests.support.command import Cli

M, F = "dense.onnx", "dense.onnx frames"
INT8 = f"{M} --scheme full --frames frames"
WRITERS = [
    f"compress {INT8}",
    f"calibrate {F}",
    f"plan {M}",
    f"sensitivity {F}",
    f"search {F} --max-mb 1",
    f"profile {F}",
]
READERS = [
    f"calibrate {F} -r r.toml",
    f"calibrate {F} --map map.toml",
    f"calibrate {M} --import trt.cache",
    f"compress {INT8} --ranges ranges.json",
    f"compress {INT8} --overrides o.toml",
    f"compress {M} -r r.toml",
    f"plan {M} --overrides o.toml",
    f"search {F} --max-mb 1 --ranges ranges.json",
    f"sensitivity {F} --adapter a.toml",
]
"""Commands whose last word is a file that they read."""
RECORDED = [
    (line, f"frames/{name}")
    for line in WRITERS
    if "frames" in line
    for name in ("000001.npz", "000002.npz", "scenes.json")
]
REFUSED = {
    **{f"{line} -o dense.onnx": "dense.onnx is the input" for line in WRITERS},
    **{f"{line} -o link.onnx": "link.onnx is the input" for line in WRITERS},
    **{
        f"{line} -o apart.onnx.data": "apart.onnx.data holds the weights of apart.onnx"
        for line in (each.replace("dense", "apart") for each in WRITERS)
    },
    **{f"{line} -o {name}": f"{name} is the input"
       for line in READERS for name in line.split()[-1:]},
    **{f"{line} -o {name}": f"{name} would be a frame of the input"
       for line, name in RECORDED},
    **{f"{line} -o no/o.x": "no/o.x: no such folder no"
       for line in WRITERS},
    **{f"{line} -o frames": "frames is a folder"
       for line in (*WRITERS, "export highway")},
    **{f"{line} -o dense.onnx": "dense.onnx is a file: name a folder"
       for line in (f"frames {M}", f"evaluate {M}", "study study.toml")},
    "study study.toml -o frames": "frames is the input: choose another folder",
}  # fmt: skip
STUDY = """
title = "one"
baseline = "blind"
routes = 1
held_out = "frames"
[[variant]]
name = "blind"
policy = "blind"
[[condition]]
name = "ideal"
latency = "none"
"""


@pytest.fixture
def folder(dense: Path) -> Path:
    """Files of every kind that a command reads."""
    for name in (line.split()[-1] for line in READERS):
        if not (dense / name).exists():
            (dense / name).write_text("the user's\n")
    (dense / "r.toml").write_text('[[pass]]\nname = "fold-constants"\n')
    (dense / "study.toml").write_text(STUDY)
    (dense / "link.onnx").symlink_to(dense / "dense.onnx")
    model = graph.load(dense / M)
    big = np.random.default_rng(0).normal(size=(1, 4096)).astype(np.float32)
    rewrite.add_constant(model.graph, big, "more")
    graph.save(model, dense / "apart.onnx", external=True)
    return dense


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("line", REFUSED)
def test_what_would_do_harm_is_refused_before_any_work(cli: Cli, line: str) -> None:
    assert REFUSED[line] in cli.refused(line)


EXACT = "--passes import-normalize -o out.onnx"
ONE = Frame(0, True, {"camera": np.zeros((1, 4), np.float32)})


@pytest.mark.parametrize("name", [".out.partial", ".out.partial.before"])
def test_recording_leaves_folders_it_did_not_make(tmp_path: Path, name: str) -> None:
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


def test_names_that_lead_nowhere_are_one_line(
    cli: Cli, files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (files / "out.onnx").symlink_to("other.onnx")
    (files / "other.onnx").symlink_to("out.onnx")
    said = cli.refused(f"compress in.onnx {EXACT}")
    assert said.startswith("me2e-compress: out.onnx is there")

    name = os.fsdecode(b"\xff.onnx")
    said = cli.refused(f"compress in.onnx {EXACT.replace('out.onnx', name)}")
    assert said == "me2e-compress: '\\udcff.onnx' is not UTF-8: rename the file"

    (files / "gone").mkdir()
    monkeypatch.chdir(files / "gone")
    (files / "gone").rmdir()
    said = cli.refused(f"compress {files}/in.onnx {EXACT}")
    assert said == "me2e-compress: the current folder: No such file or directory"
