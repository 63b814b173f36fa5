"""``compress`` that makes nothing int8: an error, or said first and last."""

from pathlib import Path

import numpy as np
import pytest

import me2e_compress as me2e
from me2e_compress import graph
from me2e_compress.workflows.result import Listener
from tests.command import Command
from tests.frames import record
from tests.nets import net

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
    assert "0 convolutions and matrix products in the graph" in said
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
