"""``compress`` that makes nothing int8: an error, or said first and last."""

from pathlib import Path

import numpy as np
import pytest

import me2e_compress as me2e
from me2e_compress import graph
from me2e_compress.errors import PreconditionError
from me2e_compress.workflows.result import Listener
from tests.command import Command
from tests.frames import record
from tests.nets import image, net, parsed, stored

NO_LAYER = """
net (float[4,1,32] x, float[1,128,32] w, float[1,128,32] r) => (float[4,1,1,32] y) {
    ["/head/LSTM"] y = LSTM<hidden_size=32>(x, w, r)
}
"""


@pytest.fixture
def lstm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A graph without a layer that anything makes int8; the current folder."""
    weights = {name: np.ones((1, 128, 32)) for name in "wr"}
    graph.save(net(NO_LAYER, weights), tmp_path / "in.onnx")
    frame = {"x": np.ones((4, 1, 32), np.float32)}
    record(tmp_path / "frames", [frame, frame])
    monkeypatch.chdir(tmp_path)
    return tmp_path


EMPTY = ("compress", "in.onnx", "--scheme", "full", "--frames", "frames")


def test_nothing_int8_is_an_error_and_writes_nothing(
    command: Command, lstm: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(lstm.iterdir())

    assert command(*EMPTY, "-o", "out.onnx") == 1

    said = capsys.readouterr().err
    assert "made nothing int8" in said
    assert "0 layers (convolutions, matrix products) in the graph" in said
    assert "-r exact writes a graph without int8" in said
    assert sorted(lstm.iterdir()) == before


def test_nothing_int8_is_said_first_and_last_where_it_is_allowed(lstm: Path) -> None:
    warned = list[str]()
    options = me2e.CompressOptions(scheme="full", allow_empty=True)
    listener = Listener(on_warning=warned.append)
    found = me2e.compress("in.onnx", "out.onnx", None, "frames", options, listener)

    assert "made nothing int8" in warned[0]
    assert "made nothing int8" in (*found.lines(), *found.alerts())[-1]
    assert (lstm / "out.onnx").is_file()


def test_what_the_target_leaves_float_is_named_as_the_reason(tmp_path: Path) -> None:
    text = """up (float[1,3,8,8] image, float[3,8,2,2] w) => (float[1,8,16,16] y) {
        ["/backbone/Up"] y = ConvTranspose<strides=[2,2]>(image, w) }"""
    weights = {"w": np.ones((3, 8, 2, 2), np.float32)}
    graph.save(stored(parsed(text), weights), tmp_path / "up.onnx")
    frames = record(tmp_path / "frames", [image(0), image(1)])
    options = me2e.CompressOptions(scheme="full", rules="paper")
    why = "1 layer .* in the graph; 1 by rule target: there is no int8"
    with pytest.raises(PreconditionError, match=why):
        me2e.compress(tmp_path / "up.onnx", tmp_path / "o.onnx", None, frames, options)
