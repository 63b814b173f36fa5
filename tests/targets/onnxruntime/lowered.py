"""Lower small graphs, and see what onnxruntime makes of them."""

import tempfile
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import onnx
import onnx_ir as ir
import onnxruntime as ort

from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.quantization.plan import make_plan
from me2e_compress.runtime.session import Session
from me2e_compress.targets.onnxruntime import OnnxRuntime
from tests.support.frames import record
from tests.support.nets import FULL, PAPER, drawn, placed

Floats = npt.NDArray[np.float32]
Feeds = Mapping[str, Floats]

BLOCK = """
block (float[1,4,16,16] x, float[8,4,3,3] w1, float[8] b1, float[8,8,1,1] w2,
       float[8] b2, float[8,8,3,3] w3, float[8] b3, float[8,8,1,1] w4)
    => (float[1,8,8,8] y, float[1,8] pooled) {
    z1 = Conv<kernel_shape=[3,3], pads=[1,1,1,1]>(x, w1, b1)
    a1 = Relu(z1)
    p1 = MaxPool<kernel_shape=[2,2], strides=[2,2]>(a1)
    z2 = Conv<kernel_shape=[1,1]>(p1, w2, b2)
    a2 = Relu(z2)
    z3 = Conv<kernel_shape=[3,3], pads=[1,1,1,1]>(a2, w3, b3)
    sum = Add(z3, p1)
    a3 = Relu(sum)
    y = Conv<kernel_shape=[1,1]>(a3, w4)
    mean = GlobalAveragePool(a3)
    pooled = Flatten(mean)
}
"""
BLOCK_SHAPES = {
    "w1": (8, 4, 3, 3), "b1": (8,), "w2": (8, 8, 1, 1), "b2": (8,),
    "w3": (8, 8, 3, 3), "b3": (8,), "w4": (8, 8, 1, 1),
}  # fmt: skip

LINEAR = """
linear (float[2,12,8] x, float[6,5] t, float[8,16] w1, float[16] b1, float[16,8] w2,
        float[7,5] turned, float[7] b3)
    => (float[2,12,8] y, float[6,7] z, float[2,12,8] doubled) {
    m1 = MatMul(x, w1)
    s1 = Add(b1, m1)
    a1 = Relu(s1)
    y = MatMul(a1, w2)
    z = Gemm<transB=1>(t, turned, b3)
    doubled = Add(x, y)
}
"""
LINEAR_SHAPES = {
    "w1": (8, 16), "b1": (16,), "w2": (16, 8), "turned": (7, 5), "b3": (7,),
}  # fmt: skip


MATMUL_RELU = """
m (float[2,6,8] x) => (float[2,6,8] y)
<int8[1,1] i = {3}, float s = {0.5}, int8 n = {0}, uint8 z = {128},
 int64[2] full = {8, 8}> {
    q = QuantizeLinear(x, s, z)
    d = DequantizeLinear(q, s, z)
    e = Expand(i, full)
    v = DequantizeLinear(e, s, n)
    ["/head/fc"] p = MatMul(d, v)
    ["/head/act"] r = Relu(p)
    y = Neg(r)
}
"""
"""A layer that is int8 in the file, and that onnxruntime runs in float."""


def feeds(seed: int, **shapes: tuple[int, ...]) -> Feeds:
    generator = np.random.default_rng(seed)
    return {
        name: generator.standard_normal(shape).astype(np.float32)
        for name, shape in shapes.items()
    }


def block(seed: int = 0) -> ir.Model:
    return drawn(BLOCK, BLOCK_SHAPES, seed)


def linear(seed: int = 0) -> ir.Model:
    return drawn(LINEAR, LINEAR_SHAPES, seed)


IMAGE = feeds(1, x=(1, 4, 16, 16))
TOKENS = feeds(1, x=(2, 12, 8), t=(6, 5))


def lowered(model: ir.Model, reach: float = 3.0) -> ir.Model:
    """Lower with one range for all."""
    return placed(model, "onnxruntime", ends=(-reach, reach))


def measured(model: ir.Model, tensors: tuple[str, ...], feeds: Feeds) -> Ranges:
    """Calibrate on one frame."""
    with tempfile.TemporaryDirectory() as folder:
        frames = CalibrationSet(record(Path(folder) / "frames", [feeds]))
        return Calibrator(threads=1).run(model, tensors, frames)


def calibrated(model: ir.Model, feeds: Feeds) -> ir.Model:
    """Lower with the ranges of one frame."""
    plan = make_plan(model, FULL, PAPER)
    return OnnxRuntime().place(
        model, plan, measured(model, OnnxRuntime().tensors(plan, model), feeds)
    )


def kernels(model: ir.Model) -> Counter[str]:
    """Count the operators that onnxruntime runs, once it has optimized a graph."""
    options = ort.SessionOptions()
    options.log_severity_level = 4
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "optimized.onnx"
        options.optimized_model_filepath = str(path)
        source = ir.to_proto(model).SerializeToString()
        ort.InferenceSession(source, options, providers=["CPUExecutionProvider"])
        return Counter(node.op_type for node in onnx.load(path).graph.node)


def ran(model: ir.Model, fed: Feeds, *, optimize: bool = True) -> dict[str, Floats]:
    """Run once, on one thread."""
    found = Session(model, threads=1, optimize=optimize).run(fed)
    return {name: array.astype(np.float32) for name, array in found.items()}


def sqnr_db(want: Floats, got: Floats) -> float:
    """Signal to quantization noise, dB."""
    noise = float(((want - got).astype(np.float64) ** 2).sum())
    signal = float((want.astype(np.float64) ** 2).sum())
    return float("inf") if noise == 0 else 10 * float(np.log10(signal / noise))
