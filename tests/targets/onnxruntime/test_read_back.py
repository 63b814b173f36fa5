"""What the plan makes int8 runs int8: each form, opened, and read back."""

import onnx_ir as ir
import pytest

from me2e_compress.targets.onnxruntime import OnnxRuntime
from tests.nets import parsed
from tests.targets.onnxruntime.lowered import (
    MATMUL_RELU,
    calibrated,
    drawn,
    feeds,
    kernels,
    ran,
    sqnr_db,
)

HEAD = '<ir_version: 9, opset_import: ["" : 17]>\n'
SHAPES = {
    "w": (8, 8), "v": (8, 8), "b": (8,), "k": (8, 4, 3, 3), "kb": (8,),
    "k2": (4, 8, 1, 1),
}  # fmt: skip
WEIGHTS = ", ".join(
    f"float[{','.join(map(str, shape))}] {name}" for name, shape in SHAPES.items()
)
TWO, THREE, IMAGE = (6, 8), (2, 6, 8), (1, 4, 6, 6)
FORMS = {
    "matmul-add": (THREE, "m = MatMul(x, w) y = Add(m, b)"),
    "matmul": (THREE, "y = MatMul(x, w)"),
    "matmul-of-two": (TWO, "y = MatMul(x, w)"),
    "matmul-relu": (THREE, "m = MatMul(x, w) r = Relu(m) y = Neg(r)"),
    "matmul-clip": (THREE, "m = MatMul(x, w) r = Clip(m, l) y = Neg(r)"),
    "matmul-sigmoid": (THREE, "m = MatMul(x, w) r = Sigmoid(m) y = Neg(r)"),
    "matmul-residual": (THREE, "m = MatMul(x, w) y = Add(m, x)"),
    "matmul-residual-of-two": (TWO, "m = MatMul(x, w) y = Add(m, x)"),
    "matmul-computed-bias": (THREE, "s = Abs(b) m = MatMul(x, w) y = Add(m, s)"),
    "matmul-scaled": (THREE, "m = MatMul(x, w) y = Mul(m, l)"),
    "matmul-gelu": (
        THREE,
        "m = MatMul(x, w) d = Div(m, q) e = Erf(d) p = Add(e, o) h = Mul(m, p)"
        " y = Mul(h, l)",
    ),
    "matmul-norm": (
        THREE,
        "m = MatMul(x, w) a = Add(m, x) y = LayerNormalization(a, b, b)",
    ),
    "gemm": (TWO, "y = Gemm(x, w, b)"),
    "gemm-bare": (TWO, "y = Gemm(x, w)"),
    "gemm-reshaped": (
        THREE,
        "r = Reshape(x, rows) m = Gemm(r, w, b) y = Reshape(m, back)",
    ),
    "gemm-transposed": (TWO, "y = Gemm<transB=1>(x, w, b)"),
    "gemm-relu": (TWO, "m = Gemm(x, w, b) r = Relu(m) y = Neg(r)"),
    "gemm-relu-last": (TWO, "m = Gemm(x, w, b) y = Relu(m)"),
    "gemm-residual": (TWO, "m = Gemm(x, w, b) y = Add(m, x)"),
    "two-of-one": (THREE, "m = MatMul(x, w) n = MatMul(x, v) y = Mul(m, n)"),
    "chain": (TWO, "m = Gemm(x, w, b) r = Relu(m) y = Gemm(r, v, b)"),
    "chain-read-between": (
        TWO,
        "m = Gemm(x, w, b) n = Gemm(m, v, b) y = Add(m, n)",
    ),
    "chain-read-behind-relu": (
        THREE,
        "m = MatMul(x, w) r = Relu(m) n = MatMul(r, v) y = Add(r, n)",
    ),
    "conv": (IMAGE, "y = Conv<kernel_shape=[3,3]>(x, k, kb)"),
    "conv-bare": (IMAGE, "y = Conv<kernel_shape=[3,3]>(x, k)"),
    "conv-relu": (IMAGE, "c = Conv<kernel_shape=[3,3]>(x, k, kb) y = Relu(c)"),
    "conv-clip": (IMAGE, "c = Conv<kernel_shape=[3,3]>(x, k, kb) y = Clip(c, z, six)"),
    "conv-swish": (
        IMAGE,
        "c = Conv<kernel_shape=[3,3]>(x, k, kb) s = HardSigmoid(c) y = Mul(c, s)",
    ),
    "conv-read-twice": (
        IMAGE,
        "c = Conv<kernel_shape=[3,3]>(x, k, kb) r = Relu(c) y = Add(c, r)",
    ),
    "conv-residual": (
        IMAGE,
        "c = Conv<kernel_shape=[3,3], pads=[1,1,1,1]>(x, k, kb) d = Conv(c, k2)"
        " y = Add(d, x)",
    ),
}  # fmt: skip
FLOAT = {
    "Conv", "FusedConv", "FusedGemm", "FusedMatMul", "Gemm", "MatMul", "NhwcFusedConv",
}  # fmt: skip
INT8 = {"MatMulIntegerToFloat", "QGemm", "QLinearConv", "QLinearMatMul"}


def form(name: str) -> tuple[ir.Model, tuple[int, ...]]:
    """Return a float graph of one or two layers, and the shape of its input."""
    shape, body = FORMS[name]
    sizes = ",".join(map(str, shape))
    text = (
        f"form (float[{sizes}] x, {WEIGHTS}) => (float[{','.join('?' * len(shape))}] y)"
        " <float l = {0.5}, float z = {0.0}, float six = {6.0}, float o = {1.0},"
        " float q = {1.4142135}, int64[2] rows = {-1, 8}, int64[3] back = {2, 6, 8}>"
    )
    return drawn(f"{HEAD}{text} {{ {body} }}", SHAPES), shape


@pytest.mark.parametrize("name", FORMS)
def test_every_layer_of_a_form_runs_in_int8(name: str) -> None:
    model, shape = form(name)
    layers = [n for n in model.graph if n.op_type in ("Conv", "Gemm", "MatMul")]

    fed = feeds(3, x=shape)

    small = calibrated(model, fed)
    found = kernels(small)

    assert not FLOAT & set(found)
    assert sum(found[each] for each in INT8) == len(layers)
    assert OnnxRuntime().read_back(small) == ()
    assert sqnr_db(ran(model, fed)["y"], ran(small, fed)["y"]) > 15


def test_a_layer_that_onnxruntime_runs_in_float_is_named_as_in_the_file() -> None:
    (found,) = OnnxRuntime().read_back(parsed(MATMUL_RELU))

    assert (found.severity, found.rule, found.node) == (
        "warning",
        "float-kernel",
        "/head/fc",
    )
    assert found.message == "reads int8, and runs in float, as MatMul; Relu reads it"
