"""No command writes over what it reads, and none works before it can write."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from me2e_compress import graph, rewrite
from tests.cli.conftest import Command

Refused = Callable[[str], str]

M, F = "dense.onnx", "dense.onnx frames"
INT8 = f"{M} --scheme full --frames frames"
WRITERS = [
    f"compress {INT8}",
    f"calibrate {F}",
    f"calibrate {F} --shard 1/1",
    f"plan {M}",
    f"sensitivity {F}",
    f"search {F} --max-mb 1",
    f"profile {F}",
]
INPUTS = {
    f"calibrate {F} -r r.toml": "r.toml",
    f"calibrate {F} --map map.toml": "map.toml",
    f"calibrate {M} --merge s.npz": "s.npz",
    f"calibrate {M} --import trt.cache": "trt.cache",
    f"compress {INT8} --ranges ranges.json": "ranges.json",
    f"compress {INT8} --overrides o.toml": "o.toml",
    f"compress {M} -r r.toml": "r.toml",
    f"plan {M} --overrides o.toml": "o.toml",
    f"plan {M} --against other.onnx": "other.onnx",
    f"search {F} --max-mb 1 --ranges ranges.json": "ranges.json",
    f"sensitivity {F} --drive 1 --adapter a.toml": "a.toml",
}
FOLDERS = [f"frames {M}", f"evaluate {M}", "study study.toml"]


@pytest.fixture
def refused(
    command: Command,
    dense: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> Refused:
    """Run a line that must be refused before any work; give what it says."""
    monkeypatch.chdir(dense)
    for _, name in INPUTS.items():
        if not (dense / name).exists():
            (dense / name).write_text("the user's\n")
    (dense / "r.toml").write_text('[[pass]]\nname = "fold-constants"\n')

    def run(line: str) -> str:
        before = {p: p.read_bytes() for p in dense.rglob("*") if p.is_file()}
        assert command(*line.split()) == 1
        assert {p: p.read_bytes() for p in dense.rglob("*") if p.is_file()} == before
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        return error

    return run


@pytest.mark.parametrize("line", WRITERS)
def test_the_model_is_not_written_over(refused: Refused, line: str) -> None:
    assert "dense.onnx is the input" in refused(f"{line} -o dense.onnx")


@pytest.mark.parametrize("line", WRITERS)
def test_a_link_to_the_model_is_the_model(
    refused: Refused, dense: Path, line: str
) -> None:
    (dense / "link.onnx").symlink_to(dense / "dense.onnx")

    assert "link.onnx is the input" in refused(f"{line} -o link.onnx")


@pytest.mark.parametrize(("line", "name"), INPUTS.items())
def test_no_other_input_is_written_over(refused: Refused, line: str, name: str) -> None:
    assert f"{name} is the input" in refused(f"{line} -o {name}")


@pytest.mark.parametrize("line", WRITERS)
def test_the_weights_beside_a_model_are_not_written_over(
    refused: Refused, dense: Path, line: str
) -> None:
    model = graph.load(dense / M)
    big = np.random.default_rng(0).normal(size=(1, 4096)).astype(np.float32)
    rewrite.add_constant(model.graph, big, "more")
    graph.save(model, dense / "dense.onnx", external=True)

    line = refused(f"{line} -o dense.onnx.data")
    assert "dense.onnx.data holds the weights of dense.onnx" in line


@pytest.mark.parametrize("name", ["000001.npz", "000002.npz", "scenes.json"])
@pytest.mark.parametrize("line", [w for w in WRITERS if "frames" in w])
def test_a_recording_stays_as_it_is(refused: Refused, line: str, name: str) -> None:
    said = refused(f"{line} -o frames/{name}")
    assert f"frames/{name} would be a frame of the input" in said


@pytest.mark.parametrize("line", [*WRITERS, "routes"])
def test_a_folder_that_is_not_there_is_said_before_any_work(
    refused: Refused, line: str
) -> None:
    assert "no/o.x: no such folder no" in refused(f"{line} -o no/o.x")


@pytest.mark.parametrize("line", [*WRITERS, "routes", "export vad-tiny"])
def test_a_folder_is_no_file(refused: Refused, line: str) -> None:
    assert "frames is a folder" in refused(f"{line} -o frames")


@pytest.mark.parametrize("line", FOLDERS)
def test_a_file_is_no_folder(refused: Refused, dense: Path, line: str) -> None:
    (dense / "study.toml").write_text(STUDY)

    assert "dense.onnx is a file: name a folder" in refused(f"{line} -o dense.onnx")


def test_a_study_does_not_write_among_its_frames(refused: Refused, dense: Path) -> None:
    (dense / "study.toml").write_text(f'held_out = "frames"\n{STUDY}')

    line = refused("study study.toml -o frames")
    assert "frames is the input: choose another folder" in line


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--tensorrt-cache dense.onnx", "dense.onnx is the input"),
        ("--tensorrt-cache no/c", "no/c: no such folder no"),
        ("--tensorrt-cache ranges.json", "ranges.json is named for two outputs"),
        ("--onnxruntime-table dense.onnx", "dense.onnx is a file"),
        ("--onnxruntime-table frames", "frames is the input: choose another folder"),
    ],
)
def test_caches_for_other_tools_do_no_harm(
    refused: Refused, words: str, message: str
) -> None:
    assert message in refused(f"calibrate {F} -o ranges.json {words}")


def test_a_table_is_not_written_over_the_one_that_is_read(
    refused: Refused, dense: Path
) -> None:
    (dense / "table").mkdir()
    shutil.move(dense / "trt.cache", dense / "table" / "calibration.cache")

    words = "--import table/calibration.cache --onnxruntime-table table"
    line = refused(f"calibrate {M} {words} -o new.json")
    assert "table/calibration.cache is the input" in line


STUDY = """
title = "one"
baseline = "blind"
routes = 1
[[scheme]]
name = "blind"
policy = "blind"
[[condition]]
name = "ideal"
latency = "none"
"""
