"""What int8 cannot be made of: one line that says so, and no file."""

import json
import re
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from me2e_compress import graph
from tests.cli.conftest import Command, write_frames

Refused = Callable[..., str]


@pytest.fixture
def refused(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> Refused:
    """Compress to int8 with these words more; give the line that refuses it."""

    def run(*words: str | Path, model: str = "dense.onnx") -> str:
        out = dense / "refused.onnx"
        done = command(
            *("compress", dense / model, "--map", dense / "map.toml", "-o", out),
            *words,
        )
        error = capsys.readouterr().err
        assert done == 1
        assert error.count("\n") == 1
        assert not out.exists()
        return error

    return run


@pytest.mark.parametrize(
    ("words", "advice"),
    [
        (("-r", "full", "--scheme", "full"), "leave out --scheme"),
        (("--passes", "quantize-int8", "--scheme", "full"), "leave out --scheme"),
        (("--passes", "quantize-int8,quantize-int8"), "leave out one of them"),
    ],
)
def test_int8_twice(
    refused: Refused, dense: Path, words: tuple[str, ...], advice: str
) -> None:
    line = refused(*words, "--frames", dense / "frames")

    assert "quantize-int8 is twice in the pipeline" in line
    assert advice in line


def test_no_frames(refused: Refused, dense: Path) -> None:
    (dense / "empty").mkdir()

    assert "never made up" in refused("--scheme", "full")
    line = refused("--scheme", "full", "--frames", dense / "empty")
    assert "empty: holds no .npz frames" in line


@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        ("radar", (4, 16), "camera is missing"),
        ("camera", (2, 16), r"\[2, 16\]|\(2, 16\)"),
    ],
)
def test_frames_of_another_model(
    refused: Refused, dense: Path, name: str, shape: tuple[int, int], message: str
) -> None:
    write_frames(dense / "other", **{name: np.zeros(shape, np.float32)})

    assert re.search(message, refused("--scheme", "full", "--frames", dense / "other"))


@pytest.mark.parametrize(
    "text",
    [
        '[[override]]\nnodes = "/radar/*"\ndtype = "float"',
        '[[override]]\nmodule = "radar"\ndtype = "float"',
        '[[override]]\nreads = "radar"\ndtype = "float"',
        '[[concat]]\nnodes = "/radar/*"\nscale = "own"',
    ],
)
def test_an_override_that_matches_nothing(
    refused: Refused, dense: Path, text: str
) -> None:
    (dense / "o.toml").write_text(text)
    words = ("--scheme", "full", "--frames", dense / "frames")

    line = refused(*words, "--overrides", dense / "o.toml")

    assert re.search(r"'?(/radar/\*|radar)'? matches none of 2 nodes", line)


def test_a_cache_of_another_model(
    command: Command, refused: Refused, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    saved, map_ = dense / "r.json", ("--map", dense / "map.toml")
    command("calibrate", dense / "dense.onnx", dense / "frames", *map_, "-o", saved)
    model = graph.load(dense / "dense.onnx")
    model.graph[1].name = "/plan_head/Other"
    graph.save(model, dense / "other.onnx")
    capsys.readouterr()

    words = ("--scheme", "full", "--ranges", saved)
    assert "stale: of graph" in refused(*words, model="other.onnx")


def test_a_cache_of_other_frames(
    command: Command, refused: Refused, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    saved, map_ = dense / "r.json", ("--map", dense / "map.toml")
    command("calibrate", dense / "dense.onnx", dense / "frames", *map_, "-o", saved)
    write_frames(dense / "later", camera=np.ones((4, 16), np.float32))
    capsys.readouterr()

    words = ("--scheme", "full", "--ranges", saved, "--frames", dense / "later")
    assert "stale: of frames" in refused(*words)


@pytest.mark.parametrize(
    ("ends", "found"),
    [
        ([float("nan"), 1], "nan to 1"),
        ([-1, float("inf")], "-1 to inf"),
        ([-1e39, 1], "-1e+39 to 1"),
        ([2, 1], "2 to 1"),
    ],
)
def test_ranges_that_are_none(
    command: Command,
    refused: Refused,
    dense: Path,
    capsys: pytest.CaptureFixture[str],
    ends: list[float],
    found: str,
) -> None:
    saved, map_ = dense / "r.json", ("--map", dense / "map.toml")
    command("calibrate", dense / "dense.onnx", dense / "frames", *map_, "-o", saved)
    content = json.loads(saved.read_text())
    content["tensors"] |= {"a": ends}
    saved.write_text(json.dumps(content))
    capsys.readouterr()

    line = refused("--scheme", "full", "--ranges", saved)
    assert f"r.json: not ranges: a has {found}; " in line


@pytest.mark.parametrize("wanted", ["int4", "fp8"])
def test_formats_that_are_not_made(refused: Refused, dense: Path, wanted: str) -> None:
    frames = ("--frames", dense / "frames")
    (dense / "o.toml").write_text(f'[[override]]\nop = "MatMul"\ndtype = "{wanted}"')
    how = ("--scheme", "full", *frames)

    assert f"no scheme {wanted}; " in refused("--scheme", wanted, *frames)
    assert f"no rule set '{wanted}'; " in refused(*how, "--rules", wanted)
    assert f"no target '{wanted}'; " in refused(*how, "--target", wanted)
    assert f"no calibration method '{wanted}'; " in refused(*how, "--method", wanted)
    line = refused(*how, "--overrides", dense / "o.toml")
    assert f"dtype {wanted}: only int8 and float are supported" in line


@pytest.mark.parametrize("target", ["tensorrt", "onnxruntime"])
def test_a_graph_that_is_quantized_already(
    command: Command,
    refused: Refused,
    dense: Path,
    target: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ("--scheme", "full", "--frames", dense / "frames")
    map_ = ("--map", dense / "map.toml")
    made = command(
        *("compress", dense / "dense.onnx", *words, *map_, "--target", target),
        *("-o", dense / "int8.onnx"),
    )
    capsys.readouterr()

    assert made == 0
    line = refused(*words, model="int8.onnx")
    assert "quantized already: " in line
    assert "give the float graph that it was made of" in line


def bare(path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, np.zeros((4, 16), np.float32))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-40])


def damaged(path: Path) -> None:
    """Compress it, and break what was compressed."""
    arrays = dict(np.load(path))
    np.savez_compressed(path, **arrays)
    content = bytearray(path.read_bytes())
    begin = content.index(b"camera.npy") + len(b"camera.npy") + 20
    content[begin] = 0xFF
    path.write_bytes(bytes(content))


def no_array(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("camera", "words")


def encrypted(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[6] |= 1
    content[content.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(bytes(content))


@pytest.mark.parametrize("harm", [bare, cut, damaged, no_array, encrypted])
def test_a_recording_that_cannot_be_read(
    refused: Refused, dense: Path, harm: Callable[[Path], None]
) -> None:
    harm(dense / "frames" / "000001.npz")

    line = refused("--scheme", "full", "--frames", dense / "frames")
    assert "000001.npz: not a readable .npz (" in line


LATIN = "caf\u00e9".encode("latin-1")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("-r", "bad.toml"), "bad.toml is not TOML"),
        (("--scheme", "full", "--overrides", "bad.toml"), "bad.toml: not TOML"),
        (("--scheme", "full", "--map", "bad.toml"), "bad.toml: not TOML"),
        (("--scheme", "full", "--ranges", "bad.toml"), "bad.toml: not ranges"),
    ],
)
def test_a_file_that_is_no_text(
    refused: Refused,
    dense: Path,
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
    message: str,
) -> None:
    monkeypatch.chdir(dense)
    (dense / "bad.toml").write_bytes(LATIN)

    assert message in refused(*words)


def test_a_plan_that_is_no_text(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (dense / "p.json").write_bytes(LATIN)

    assert command("plan", dense / "p.json") == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "p.json: not a plan" in error


def without_a_tensor(path: Path) -> None:
    arrays = dict(np.load(path))
    np.savez(path, **{**arrays, "tensors": arrays["tensors"][1:]})


def without_a_number(path: Path) -> None:
    arrays = dict(np.load(path))
    np.savez(path, **{**arrays, "measured": arrays["measured"] * np.float32(np.nan)})


@pytest.mark.parametrize(
    "harm", [bare, cut, no_array, encrypted, without_a_tensor, without_a_number]
)
def test_a_shard_that_cannot_be_read(
    command: Command,
    dense: Path,
    capsys: pytest.CaptureFixture[str],
    harm: Callable[[Path], None],
) -> None:
    place = ("--map", dense / "map.toml", "-o", dense / "s.npz")
    frames = (dense / "frames", "--shard", "1/1")
    assert command("calibrate", dense / "dense.onnx", *frames, *place) == 0
    harm(dense / "s.npz")
    capsys.readouterr()

    shard = ("--merge", dense / "s.npz", "-o", dense / "r.json")
    assert command("calibrate", dense / "dense.onnx", *shard) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "s.npz: not saved statistics (" in error
