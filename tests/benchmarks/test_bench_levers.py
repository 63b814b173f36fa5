"""Every lever opens a session that gives what ours gives."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import onnx_ir as ir
import pytest

from benchmarks.bench_levers import LEVERS, Feeds, Lever, first_frame, measured, opened
from tests.frames import record

TEXT = """
<ir_version: 9, opset_import: ["" : 17]>
m (float[1,2,4] x, float[1,2,4] prev_x) => (float[1,2,4] y, float[1,2,4] next_x)
    <float[4] s = {1.0, 2.0, 3.0, 4.0}> {
    a = Add(x, prev_x)
    y = LayerNormalization(a, s, s)
    next_x = Identity(a)
}
"""


@pytest.fixture
def model(tmp_path: Path) -> Path:
    ir.save(ir.from_onnx_text(TEXT), tmp_path / "m.onnx")
    return tmp_path / "m.onnx"


def answer(model: Path, feeds: Feeds, lever: Lever) -> npt.NDArray[np.float32]:
    return np.asarray(opened(model, 1, lever).run(["y"], dict(feeds))[0])


def test_every_setting_is_known_to_onnxruntime(model: Path) -> None:
    feeds = {name: np.ones((1, 2, 4), np.float32) for name in ("x", "prev_x")}
    want = answer(model, feeds, Lever())

    for lever in LEVERS.values():
        assert np.allclose(want, answer(model, feeds, lever), atol=1e-5)


def test_bound_inputs_are_run_as_others_are(model: Path, tmp_path: Path) -> None:
    x = np.ones((1, 2, 4), np.float32)
    feeds = first_frame(model, record(tmp_path / "frames", [{"x": x}]))

    assert not feeds["prev_x"].any()  # the state of a first frame
    taken = measured(model, feeds, LEVERS["IO binding"], threads=1, rounds=1)
    assert all(each.run >= 0 for each in taken)
