"""Who times or drives a graph runs it as onnxruntime does; who measures, as written."""

from pathlib import Path

import numpy as np
import onnx_ir as ir
import onnxruntime
import pytest

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.driving import onnx_policy
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.errors import EvaluationError, GraphError
from me2e_compress.manager import PassManager
from me2e_compress.passes.base import Context
from me2e_compress.passes.import_normalize import ImportNormalize
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.runtime.profile import TimedSession
from me2e_compress.runtime.session import Session
from tests.frames import record
from tests.manager.transformer import transformer
from tests.passes.small import EVERYTHING, read
from tests.targets.onnxruntime.rewritten import Drawn


def test_what_is_timed_is_what_onnxruntime_runs(tmp_path: Path) -> None:
    layer = Drawn("Gemm", bias="own")
    path = tmp_path / "layer.onnx"
    graph.save(layer.model(), path)
    frame = layer.frame()
    plain, kernels = (
        np.asarray(Session(path, int8_kernels=s).run(frame)["y"], np.float64)
        for s in (False, True)
    )

    timed = TimedSession(path, threads=1).run(frame)["y"]

    np.testing.assert_array_equal(timed, kernels)
    assert np.abs(plain - kernels).max() > 1


def test_what_drives_is_what_onnxruntime_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, object] = {}

    def refuse(path: Path, **options: object) -> None:
        given.update(options)
        raise GraphError("seen")

    monkeypatch.setattr(onnx_policy, "Session", refuse)
    with pytest.raises(EvaluationError, match="seen"):
        OnnxPolicy.open(Path("m.onnx"))

    assert given["int8_kernels"] is True


OVERFLOWS = """<ir_version: 9, opset_import: ["" : 17]>
m (float[8,64] x) => (float[8,16] y)
<float one = {1.0}, uint8 zero = {0}, float far = {8192.0},
 float farther = {1.6e7}, int8 none = {0}> {
    q = QuantizeLinear(x, one, zero)
    d = DequantizeLinear(q, one, zero)
    v = DequantizeLinear(w, one, none)
    a = Gemm(d, v)
    b = QuantizeLinear(a, far, zero)
    c = DequantizeLinear(b, far, zero)
    e = DequantizeLinear(u, one, none)
    g = Gemm(c, e)
    f = QuantizeLinear(g, farther, zero)
    y = DequantizeLinear(f, farther, zero)
}"""
"""Two int8 layers with one zero point; the first sums products of 255 by 127."""


def test_sums_of_int8_do_not_overflow_on_any_processor(tmp_path: Path) -> None:
    draws = np.random.default_rng(0)
    large = draws.integers(100, 128, (64, 16)).astype(np.int8)
    model = read(OVERFLOWS, w=large, u=draws.integers(0, 128, (16, 16)).astype(np.int8))
    x = draws.integers(200, 256, (8, 64)).astype(np.float32)
    graph.save(model, tmp_path / "m.onnx")
    opened: list[ir.Model | Path] = [model, tmp_path / "m.onnx"]
    for source in opened:
        session = Session(source, threads=1, int8_kernels=True)
        by_kernels = session.run({"x": x})["y"]
        by_nodes = Session(source, threads=1, optimize=False).run({"x": x})["y"]
        np.testing.assert_array_equal(by_kernels, by_nodes)
    assert (x @ large).min() > 32767  # where 16 bits end


def test_a_written_file_opens_in_plain_onnxruntime_where_sums_must_not_overflow(
    tmp_path: Path,
) -> None:
    frames = np.random.default_rng(1).normal(size=(3, 1, 64, 64)).astype(np.float32)
    recording = CalibrationSet(record(tmp_path / "f", [{"x": each} for each in frames]))
    passes = (ImportNormalize(), QuantizeInt8(target="onnxruntime"))
    manager = PassManager(passes)
    model = manager.run(transformer(), Context(EVERYTHING, recording)).model
    options = onnxruntime.SessionOptions()
    options.add_session_config_entry("session.x64quantprecision", "1")
    options.intra_op_num_threads = 1

    session = onnxruntime.InferenceSession(
        ir.to_proto(model).SerializeToString(), options
    )

    (plain,) = session.run(None, {"x": frames[0]})
    ours = Session(model, threads=1, int8_kernels=True).run({"x": frames[0]})["y"]
    np.testing.assert_array_equal(np.asarray(plain), ours)
