"""State and plan: known of either file, its sizes of the frames, and from where."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.support.command import Cli, write_frames
from tests.support.nets import save_text

TEXT = """m (float[batch,4] x, float[batch,4] h) => (float[batch,4] y, float[batch,4] n)
{ n = Add(x, h) y = Tanh(n) }"""
MAP = """[modules.all]
role = "feature"
patterns = []
optional = ["**"]
[recurrent]
h = "n"
"""


@pytest.fixture
def files(cli: Cli, tmp_path: Path) -> Cli:
    save_text(tmp_path / "m.onnx", TEXT)
    (tmp_path / "map.toml").write_text(MAP)
    (tmp_path / "frames").mkdir()
    for at in range(3):
        x = np.full((1, 4), at, np.float32)
        np.savez(tmp_path / "frames" / f"{at:06d}.npz", x=x)
    index(tmp_path, '{"scenes": [0]}')
    cli.done("compress m.onnx -r exact --map map.toml --set-dim batch=1 -o small.onnx")
    return cli


def index(folder: Path, text: str) -> None:
    (folder / "frames" / "scenes.json").write_text(text)


def test_state_is_taken_from_either_file_and_said(files: Cli) -> None:
    line = "state h: metadata of small.onnx"
    assert files.document("compare m.onnx small.onnx frames")["known"] == line
    assert files.document("compare small.onnx m.onnx frames")["known"] == line
    found = files.document("profile m.onnx frames -o t.json --map map.toml")
    assert found["known"] == "state h: map map.toml"


def test_unknown_keys_of_a_recording_are_refused(files: Cli, tmp_path: Path) -> None:
    index(tmp_path, '{"scenes": [0], "sceens": [1]}')
    line = "compare m.onnx small.onnx frames"
    assert "scenes.json: unknown key 'sceens'" in files.refused(line)
    grey = {"mean": [0] * 3, "std": [1] * 3, "order": "rgb", "rows": 4, "columns": 4}
    pixels = {"inputs": {"img": grey}}
    index(tmp_path, json.dumps({"scenes": [0], "pixels": pixels}))
    assert "pixels: img is not an input of the model" in files.refused(line)


ROOTS = """m (float[1,4] x) => (float[1,4] y)
{ a = Identity(x) [root] r = Sqrt(a) [end] y = Neg(r) }"""


def test_compare_names_the_node_that_makes_nan_first(cli: Cli, tmp_path: Path) -> None:
    save_text(tmp_path / "roots.onnx", ROOTS)
    x = np.array([[4.0, 1.0, -1.0, 9.0]], np.float32)
    write_frames(tmp_path / "frames", x=x)

    found = cli.document("compare roots.onnx roots.onnx frames")

    (line,) = found["not_finite"]
    assert line.startswith("roots.onnx: root (Sqrt) is first to make NaN")
    assert line in cli.done("compare roots.onnx roots.onnx frames").out
