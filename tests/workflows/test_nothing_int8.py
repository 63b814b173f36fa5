"""``compress`` that makes nothing int8 says so first and last where it is allowed."""

from pathlib import Path

import numpy as np

import me2e_compress as me2e
from me2e_compress.workflows.result import Listener
from tests.command import write_frames
from tests.nets import save_text


def test_nothing_int8_is_said_first_and_last_where_it_is_allowed(
    tmp_path: Path,
) -> None:
    text = "m (float[1,4] x) => (float[1,4] y) { y = Relu(x) }"
    source, output = save_text(tmp_path / "in.onnx", text), tmp_path / "out.onnx"
    frames, warned = tmp_path / "frames", list[str]()
    write_frames(frames, x=np.ones((1, 4), np.float32))
    options = me2e.CompressOptions(scheme="full", allow_empty=True)
    listener = Listener(on_warning=warned.append)

    found = me2e.compress(source, output, None, frames, options, listener)

    assert "made nothing int8" in warned[0]
    assert "made nothing int8" in (*found.lines(), *found.alerts())[-1]
    assert output.is_file()
