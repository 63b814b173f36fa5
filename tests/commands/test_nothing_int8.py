"""``compress`` that makes nothing int8 says so first and last where it is allowed."""

from pathlib import Path

import numpy as np
import pytest

import me2e_compress as me2e
from me2e_compress import graph
from me2e_compress.base.errors import PreconditionError
from me2e_compress.base.listener import Listener
from tests.support.command import write_frames
from tests.support.frames import record
from tests.support.nets import image, parsed, save_text, stored


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
