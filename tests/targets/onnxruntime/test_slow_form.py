"""What a session runs in float of a quantized file, held against what we say."""

import itertools
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.runtime.providers import (
    CpuProvider,
    CudaProvider,
    TensorRtProvider,
)
from me2e_compress.targets.onnxruntime import OnnxRuntime
from me2e_compress.targets.onnxruntime.convert import slow_here
from tests.support.nets import conv_attention, drawn, parsed, placed
from tests.targets.onnxruntime.lowered import (
    MATMUL_RELU,
    calibrated,
    feeds,
    kernels,
    ran,
    sqnr_db,
)

LAYERS = {
    "Conv": ("1,8,4,4", "8,8,1,1", "c = Conv(d, v)"),
    "Conv with a bias": ("1,8,4,4", "8,8,1,1", "c = Conv(d, v, b)"),
    "ConvTranspose": ("1,8,4,4", "8,8,1,1", "c = ConvTranspose(d, v)"),
    "Gemm": ("4,8", "8,8", "c = Gemm(d, v)"),
    "Gemm with a bias": ("4,8", "8,8", "c = Gemm(d, v, b)"),
    "Gemm with an int32 bias": ("4,8", "8,8", "c = Gemm(d, v, e)"),
    "MatMul": ("2,4,8", "8,8", "c = MatMul(d, v)"),
    "MatMul with a bias": ("2,4,8", "8,8", "m = MatMul(d, v) c = Add(m, b)"),
    "MatMul of a matrix": ("4,8", "8,8", "c = MatMul(d, v)"),
}
GRIDS = (("uint8", 128), ("uint8", 0), ("int8", 0), ("int8", -128), ("int8", 5))
ENDS = {
    "float": "y = Identity(c)",
    "a pair": "a = QuantizeLinear(c, s, z) y = DequantizeLinear(a, s, z)",
    "Relu": "y = Relu(c)",
    "Relu and a pair": "r = Relu(c) a = QuantizeLinear(r, s, z)"
    " y = DequantizeLinear(a, s, z)",
    "Clip and a pair": "r = Clip(c, zero) a = QuantizeLinear(r, s, z)"
    " y = DequantizeLinear(a, s, z)",
    "Tanh and a pair": "r = Tanh(c) a = QuantizeLinear(r, s, z)"
    " y = DequantizeLinear(a, s, z)",
    "Unsqueeze and a pair": "r = Unsqueeze(c, at) a = QuantizeLinear(r, s, z)"
    " f = DequantizeLinear(a, s, z) y = Squeeze(f, at)",
    "a pair and a float reader": "a = QuantizeLinear(c, s, z)"
    " f = DequantizeLinear(a, s, z) g = Tanh(c) y = Add(f, g)",
}
TEXT = """
<ir_version: 10, opset_import: ["" : 17]>
m (float[%(read)s] x) => (float[%(answer)s] y)
<int8[%(shape)s] w = {%(weight)s}, float s = {0.05}, float t = {0.0025},
 float zero = {0.0}, int64[1] at = {0}, int8 n = {0}, int32 i = {0},
 int32[8] k = {9,8,7,6,5,4,3,2},
 float[8] b = {1,2,3,4,5,6,7,8}, %(zero)s> {
    q = QuantizeLinear(x, s, z)
    d = DequantizeLinear(q, s, z)
    v = DequantizeLinear(w, s, n)
    e = DequantizeLinear(k, t, i)
    %(body)s
}
"""


def quantized(layer: str, end: str, grid: tuple[str, int]) -> ir.Model:
    """One layer between pairs of a grid, and what reads it."""
    read, shape, call = LAYERS[layer]
    weight = np.random.default_rng(0).integers(-127, 128, 64)
    kind, zero = grid
    return ir.from_onnx_text(
        TEXT
        % {
            "read": read,
            "shape": shape,
            "answer": ",".join("n" * len(read.split(","))),
            "weight": ",".join(map(str, weight)),
            "zero": f"{kind} z = {{{zero}}}",
            "body": call + " " + ENDS[end],
        }
    )


# every grid behind every layer, and two of them in every place
CASES = [
    *itertools.product(LAYERS, ("float", "a pair"), GRIDS),
    *itertools.product(LAYERS, [*ENDS][2:], (GRIDS[0], GRIDS[3])),
]


@pytest.mark.parametrize(("layer", "end", "grid"), CASES)
def test_a_layer_is_slow_where_the_session_runs_it_in_float(
    layer: str, end: str, grid: tuple[str, int]
) -> None:
    model = quantized(layer, end, grid)

    runs = [each.rule for each in OnnxRuntime().read_back(model)]

    assert (slow_here(model) is not None) == ("float-kernel" in runs)


FLOATS = ",".join(f"{number:.3f}" for number in np.linspace(-1, 1, 64))
INTEGERS = ",".join(str(number) for number in range(-32, 32))
STORED = "v = DequantizeLinear(w, s, n)"
AS_FLOAT = "u = QuantizeLinear(w, s, n) v = DequantizeLinear(u, s, n)"


@pytest.mark.parametrize(("answered", "is_slow"), [(1, True), (2, False)])
def test_half_of_the_layers_decide(answered: int, is_slow: bool) -> None:
    pairs = "".join(
        f" c{at} = Conv(d, v) a{at} = QuantizeLinear(c{at}, s, z)"
        f" y{at} = DequantizeLinear(a{at}, s, z)"
        for at in range(answered)
    )
    outputs = ",".join(f"float[1,8,4,4] y{at}" for at in range(answered))
    model = ir.from_onnx_text(
        '<ir_version: 10, opset_import: ["" : 17]>'
        f"m (float[1,8,4,4] x) => (float[1,8,4,4] y, {outputs}) <float s = {{0.05}},"
        f" uint8 z = {{0}}, int8[8,8,1,1] w = {{{INTEGERS}}}, int8 n = {{0}}>"
        "{ q = QuantizeLinear(x, s, z) d = DequantizeLinear(q, s, z)"
        f" v = DequantizeLinear(w, s, n) y = Conv(d, v) {pairs} }}"
    )

    assert (slow_here(model) is not None) == is_slow


PRODUCT = """
<ir_version: 10, opset_import: ["" : 21]>
m (float[4,8] x) => (float[4,8] y) <float s = {0.05}, int8 n = {0}, %s z = {0}, %s> {
    q = QuantizeLinear(x, s, z) d = DequantizeLinear(q, s, z) %s y = MatMul(d, v)
}
"""


@pytest.mark.parametrize("weights", [STORED, AS_FLOAT])
@pytest.mark.parametrize(
    ("kind", "is_slow"),
    [("uint8", False), ("int8", False), ("uint16", True), ("int16", True)],
)
def test_a_lone_product_has_a_kernel_for_eight_bits(
    kind: str, weights: str, is_slow: bool
) -> None:
    constant = f"int8[8,8] w = {{{INTEGERS}}}"
    if weights == AS_FLOAT:
        constant = f"float[8,8] w = {{{FLOATS}}}"
    model = ir.from_onnx_text(PRODUCT % (kind, constant, weights))

    runs = [each.rule for each in OnnxRuntime().read_back(model)]

    assert (slow_here(model) is not None, "float-kernel" in runs) == (is_slow, is_slow)


@pytest.mark.parametrize(("kind", "is_slow"), [(2, False), (3, True)])
def test_int8_without_a_zero_point_is_not_looked_at(kind: int, is_slow: bool) -> None:
    """ONNX says that it is 0; a session takes a pair of uint8 in without one."""
    pair = f"QuantizeLinear<output_dtype={kind}>"
    model = ir.from_onnx_text(
        '<ir_version: 10, opset_import: ["" : 21]>'
        "m (float[1,8,4,4] x) => (float[1,8,4,4] y) <float s = {0.05}, int8 n = {0},"
        f" int8[8,8,1,1] w = {{{INTEGERS}}}> {{ q = {pair}(x, s)"
        f" d = DequantizeLinear(q, s) {STORED} c = Conv(d, v) a = {pair}(c, s)"
        " y = DequantizeLinear(a, s) }"
    )

    runs = [each.rule for each in OnnxRuntime().read_back(model)]

    assert (slow_here(model) is not None, "float-kernel" in runs) == (is_slow, is_slow)


def test_a_weight_alone_is_not_slow() -> None:
    """Its activation is float: such products have a kernel (MatMulNBits)."""
    model = ir.from_onnx_text(
        '<ir_version: 10, opset_import: ["" : 17]>'
        f"m (float[4,8] x) => (float[4,8] y) <int8[8,8] w = {{{INTEGERS}}},"
        " float s = {0.05}, int8 n = {0}>"
        "{ v = DequantizeLinear(w, s, n) y = MatMul(x, v) }"
    )

    assert slow_here(model) is None


def test_layers_of_a_function_count() -> None:
    model = ir.from_onnx_text(
        '<ir_version: 10, opset_import: ["" : 17, "own" : 1]>'
        "m (float[1,8,4,4] x, int8[8,8,1,1] w) => (float[1,8,4,4] y)"
        "{ y = own.Block(x, w) }"
        '<domain: "own", opset_import: ["" : 17]>'
        "Block (x, w) => (y) { s = Constant<value = float {0.05}>()"
        " z = Constant<value = int8 {0}>() q = QuantizeLinear(x, s, z)"
        " d = DequantizeLinear(q, s, z) v = DequantizeLinear(w, s, z) y = Conv(d, v) }"
    )

    assert "for 1 of 1 layers)" in (slow_here(model) or "")


# Which quantizers' files are slow in onnxruntime's CPU, and for whom.


CHAIN = """
<ir_version: 10, opset_import: ["" : %(opset)d]>
m (float[1,8,4,4] x) => (float[1,8,4,4] y)
<float s = {0.05}, %(constants)s> {
    q = %(quantize)s(x, s%(z)s)
    d = DequantizeLinear(q, s%(z)s)
    %(weights)s
    c = Conv(d, v)
    r = Relu(c)
    q2 = %(quantize)s(r, s%(z)s)
    d2 = DequantizeLinear(q2, s%(z)s)
    y = Conv(d2, v)
}
"""
LOWERED = "--passes import-normalize,lower-int8 makes it of this file"


def chain(form: str) -> ir.Model:
    """Two convolutions and a ReLU, with pairs on what layers read."""
    floats = f"float[8,8,1,1] w = {{{FLOATS}}}, int8 n = {{0}}"
    stored = f"int8[8,8,1,1] w = {{{INTEGERS}}}, int8 n = {{0}}"
    fp8 = 17  # FLOAT8E4M3FN
    constants, weights, quantize, z, opset = {
        "ours": (stored, STORED, "QuantizeLinear", ", n", 13),
        "modelopt": (floats, AS_FLOAT, "QuantizeLinear", ", n", 19),
        "no zero point": (stored, STORED, "QuantizeLinear<output_dtype=3>", "", 21),
        "fp8": (stored, STORED, f"QuantizeLinear<output_dtype={fp8}>", "", 21),
        "uint8": (f"{stored}, uint8 z = {{128}}", STORED, "QuantizeLinear", ", z", 17),
        "shifted": (f"{stored}, int8 z = {{3}}", STORED, "QuantizeLinear", ", z", 17),
        "int16": (stored, STORED, "QuantizeLinear<output_dtype=5>", "", 21),
    }[form]
    words = {"constants": constants, "weights": weights, "quantize": quantize}
    return ir.from_onnx_text(CHAIN % {**words, "z": z, "opset": opset})


@pytest.mark.parametrize(
    ("form", "shape", "remedy"),
    [
        ("ours", "TensorRT's form,", True),
        ("modelopt", "TensorRT's form,", True),
        ("no zero point", "TensorRT's form,", True),
        ("fp8", "TensorRT's form,", False),
        ("uint8", "a form that is", False),
        ("shifted", "a form that is", False),
        ("int16", "a form that is", False),
    ],
)
def test_pairs_on_inputs_alone_are_slow_whoever_placed_them(
    form: str, shape: str, remedy: bool
) -> None:
    said = slow_here(chain(form)) or ""

    assert f"quantized in {shape} slow in onnxruntime's CPU" in said
    assert "(no fast kernel for 2 of 2 layers)" in said
    assert "compress --target onnxruntime writes what is fast here" in said
    assert (LOWERED in said) == remedy


def test_another_provider_runs_that_form_well() -> None:
    model = chain("modelopt")

    assert slow_here(model, CpuProvider(plugins=(Path("library.so"),))) is not None
    for provider in (CudaProvider(), TensorRtProvider()):
        assert slow_here(model, provider) is None


@pytest.mark.parametrize(("target", "is_slow"), [("tensorrt", 1), ("onnxruntime", 0)])
def test_what_is_placed_for_the_cpu_is_not_slow_there(
    target: str, is_slow: bool
) -> None:
    model = conv_attention()

    assert slow_here(model) is None
    assert (slow_here(placed(model, target)) is not None) == is_slow


# What the plan makes int8 runs int8: each form, opened, and read back.


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
    "matmul-residual": (THREE, "m = MatMul(x, w) y = Add(m, x)"),
    "matmul-computed-bias": (THREE, "s = Abs(b) m = MatMul(x, w) y = Add(m, s)"),
    "matmul-gelu": (
        THREE,
        "m = MatMul(x, w) d = Div(m, q) e = Erf(d) p = Add(e, o) h = Mul(m, p)"
        " y = Mul(h, l)",
    ),
    "gemm": (TWO, "y = Gemm(x, w, b)"),
    "gemm-bare": (TWO, "y = Gemm(x, w)"),
    "gemm-transposed": (TWO, "y = Gemm<transB=1>(x, w, b)"),
    "gemm-relu": (TWO, "m = Gemm(x, w, b) r = Relu(m) y = Neg(r)"),
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
        " float q = {1.4142135}>"
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
