import dataclasses

import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from me2e_compress import graph
from me2e_compress.quantization.plan import make_plan
from me2e_compress.quantization.rules.rule_sets import PaperRules
from me2e_compress.targets.onnxruntime import OnnxRuntime
from me2e_compress.targets.onnxruntime.lower import (
    blocks_of,
    filter_of_blocks,
    read_blocks,
)
from me2e_compress.targets.quantized import Writer
from me2e_compress.targets.weights import QuantizedWeight
from tests.support.nets import FULL, drawn, net
from tests.support.profiles import scaled
from tests.targets.onnxruntime.lowered import (
    calibrated,
    feeds,
    kernels,
    linear,
    lowered,
    measured,
    ran,
    sqnr_db,
)


@settings(max_examples=scaled(20))
@given(seed=st.integers(0, 2**32 - 1), reach=st.floats(0.5, 8.0))
def test_numbers_are_those_of_rounding_both_operands(seed: int, reach: float) -> None:
    model = linear(seed)
    t = feeds(seed, t=(6, 5))["t"]
    fed = {"x": np.zeros((2, 12, 8), np.float32), "t": t}
    turned, bias = (
        graph.array_of(model.graph.initializers[n]) for n in ("turned", "b3")
    )
    assert turned is not None
    assert bias is not None

    got = ran(lowered(model, reach), fed, optimize=False)["z"].astype(np.float64)

    step = np.float32(reach / 127)
    rounded = np.clip(np.rint(t / step), -128, 127).astype(np.float64) * step
    channel = np.abs(turned.astype(np.float32)).max(axis=1, keepdims=True) / 127
    weight = np.rint(turned.astype(np.float32) / channel).astype(np.float64) * channel
    want = rounded @ weight.T + bias.astype(np.float64)
    # the bias is rounded too, to a 127th of a 127th
    np.testing.assert_allclose(got, want, rtol=1e-4, atol=reach / 127 * 0.05)


def test_weights_are_stored_as_int8_once_and_biases_as_int32() -> None:
    text = """
    twice (float[3,4] x, float[4,4] w, float[4] b) => (float[3,4] y) {
        h = Gemm(x, w, b)
        y = Gemm(h, w, b)
    }
    """
    model = lowered(net(text, {"w": np.ones((4, 4)), "b": np.ones(4)}))

    kinds = [
        (value.dtype, len(value.shape))
        for value in model.graph.initializers.values()
        if value.shape is not None and len(value.shape) > 0
    ]
    assert kinds.count((ir.DataType.INT8, 2)) == 1
    assert (ir.DataType.INT32, 1) in kinds
    assert "w" not in model.graph.initializers


@pytest.mark.parametrize(
    "layer",
    [
        "ConvTranspose<kernel_shape=[2,2]>(r, w, late)",
        "Conv<kernel_shape=[2,2]>(r, w, late)",
    ],
)
def test_layers_without_a_kernel_stay_float(layer: str) -> None:
    text = f"""
    odd (float[1,3,6,6] x, float[3] add, float[3,3,2,2] w) => (float[?,?,?,?] y) {{
        r = Sigmoid(x)
        late = Abs(add)
        y = {layer}
    }}
    """
    model = net(text, {"w": np.ones((3, 3, 2, 2))})

    assert graph.digest(lowered(model)) == graph.digest(model.clone())


@pytest.mark.parametrize("attributes", ["alpha=0.5", "beta=2.0", "transA=1"])
def test_a_gemm_with_factors_stays_float(attributes: str) -> None:
    text = f"""
    odd (float[4,4] x, float[4,4] w, float[4] b) => (float[4,4] y) {{
        y = Gemm<{attributes}>(x, w, b)
    }}
    """
    found = kernels(lowered(net(text, {"w": np.ones((4, 4)), "b": np.ones(4)})))

    assert found["Gemm"] == 1


@pytest.mark.parametrize("shape", ["B,12,8", "B,T,8", "B,T,3,8"])
def test_open_dimensions_stay_open(shape: str) -> None:
    text = f"""
    open (float[{shape}] x, float[8,5] w, float[5] b) => (float[{shape[:-1]}5] y) {{
        m = MatMul(x, w)
        y = Add(m, b)
    }}
    """
    generator = np.random.default_rng(0)
    model = net(text, {"w": generator.random((8, 5)), "b": generator.random(5)})
    sizes = {"B": 3, "T": 4}
    x = generator.random([sizes.get(d) or int(d) for d in shape.split(",")], np.float32)
    small = lowered(model, 1.0)

    want, got = ran(model, {"x": x})["y"], ran(small, {"x": x})["y"]

    assert got.shape == want.shape
    assert sqnr_db(want, got) > 30
    assert kernels(small)["QGemm"] == 1


def test_a_constant_that_lends_a_product_its_columns_is_no_bias() -> None:
    text = """
    lends (float[4,8] x, float[8,1] w, float[5] b) => (float[4,5] y) {
        m = MatMul(x, w)
        y = Add(m, b)
    }
    """
    model = drawn(text, {"w": (8, 1), "b": (5,)})
    plan = make_plan(model, FULL, PaperRules(without=("gemv",)))
    fed = feeds(2, x=(4, 8))

    result = OnnxRuntime().place(
        model, plan, measured(model, OnnxRuntime().tensors(plan, model), fed)
    )

    got, want = ran(result, fed)["y"], ran(model, fed)["y"]
    assert kernels(result)["QGemm"] == 0
    assert got.shape == want.shape
    assert sqnr_db(want, got) > 25


CHAIN = """
chain (float[SHAPE8] x, float[8,16] w1, float[16,8] turned, float[16] b1,
       float[16,4] w2, float[4] b2) => (float[SHAPE4] y OUTPUTS) {
    LAYERS
    m2 = MatMul(a, w2)
    y = Add(m2, b2)
}
"""
WEIGHTS = {"w1": (8, 16), "turned": (16, 8), "b1": (16,), "w2": (16, 4), "b2": (4,)}
BIASED = "m1 = MatMul(x, w1)\n s1 = Add(b1, m1)\n a = Relu(s1)"


def chain(layers: str, shape: str = "6,", outputs: str = "") -> ir.Model:
    """Draw a product that ``layers`` write, and one that reads it."""
    text = CHAIN.replace("LAYERS", layers).replace("OUTPUTS", outputs)
    return drawn(text.replace("SHAPE", shape), WEIGHTS)


@pytest.mark.parametrize(
    "layers",
    [
        BIASED,
        "m1 = MatMul(x, w1)\n a = Add(m1, b1)",
        "a = MatMul(x, w1)",
        "m1 = Gemm(x, w1, b1)\n a = Relu(m1)",
        "a = Gemm<transB=1>(x, turned)",
    ],
)
def test_a_product_that_a_layer_alone_reads_is_a_convolution(layers: str) -> None:
    model, fed = chain(layers), feeds(3, x=(6, 8))

    small = calibrated(model, fed)

    found = kernels(small)
    assert (found["QLinearConv"], found["QGemm"]) == (1, 1)
    assert found["Transpose"] == found["Relu"] == 0
    # in, and out of neither: QGemm writes float
    assert (found["QuantizeLinear"], found["DequantizeLinear"]) == (1, 0)
    assert sqnr_db(ran(model, fed)["y"], ran(small, fed)["y"]) > 30


@pytest.mark.parametrize("shape", ["2,3,", "B,3,", "B,T,", "B,2,T,"])
def test_rows_keep_their_dimensions_open_ones_too(shape: str) -> None:
    model = chain(BIASED, shape)
    sizes = [{"B": 2, "T": 3}.get(d) or int(d) for d in shape.split(",")[:-1]]
    fed = feeds(4, x=(*sizes, 8))

    small = calibrated(model, fed)

    want, got = ran(model, fed)["y"], ran(small, fed)["y"]
    assert kernels(small)["QLinearConv"] == 1
    assert got.shape == want.shape
    assert sqnr_db(want, got) > 30


@pytest.mark.parametrize(
    ("layers", "outputs"),
    [
        (BIASED, ", float[6,16] a"),
        (f"{BIASED}\n other = Exp(a)", ", float[6,16] other"),
        (f"{BIASED}\n other = Exp(s1)", ", float[6,16] other"),
    ],
)
def test_a_product_that_is_also_read_in_float_stays_one(
    layers: str, outputs: str
) -> None:
    model, fed = chain(layers, outputs=outputs), feeds(3, x=(6, 8))

    small = calibrated(model, fed)

    assert kernels(small)["QLinearConv"] == 0
    for name, want in ran(model, fed).items():
        assert sqnr_db(want, ran(small, fed)[name]) > 25


STEM = """
stem (float[1,{channels},{height},{width}] x, float[5,{channels},{kernel},{kernel}] w)
    => (float[?,?,?,?] y) {{
    y = Conv<{options}>(x, w)
}}
"""


@dataclasses.dataclass(frozen=True)
class Stem:
    channels: int = 3
    height: int = 12
    width: int = 8
    kernel: int = 7
    options: str = "strides=[2,2], pads=[3,3,3,3]"

    def text(self) -> str:
        return STEM.format(**dataclasses.asdict(self))

    @property
    def image(self) -> tuple[int, ...]:
        return 1, self.channels, self.height, self.width

    @property
    def filter(self) -> tuple[int, ...]:
        return 5, self.channels, self.kernel, self.kernel


@settings(max_examples=scaled(15))
@given(
    seed=st.integers(0, 2**32 - 1),
    channels=st.integers(1, 3),
    blocks=st.tuples(st.integers(2, 6), st.integers(2, 6)),
    kernel=st.integers(1, 7),
    stride=st.integers(2, 4),
    pads=st.tuples(*[st.integers(0, 3)] * 4),
)
def test_a_filter_over_blocks_adds_up_the_same_products(
    seed: int,
    channels: int,
    blocks: tuple[int, int],
    kernel: int,
    stride: int,
    pads: tuple[int, ...],
) -> None:
    height, width = (stride * each for each in blocks)
    options = f"strides=[{stride},{stride}], pads={list(pads)}"
    stem = Stem(channels, height, width, kernel, options)
    assume(kernel <= min(height + pads[0] + pads[2], width + pads[1] + pads[3]))
    generator = np.random.default_rng(seed)
    integers = generator.integers(-127, 128, stem.filter).astype(np.int8)
    fed = {"x": generator.integers(-9, 9, stem.image).astype(np.float32)}
    model = net(stem.text(), {"w": integers.astype(np.float32)})
    node = model.graph[0]
    cut = blocks_of(node)
    assume(cut is not None)
    assert cut is not None
    want = ran(model, fed)["y"]

    weight = QuantizedWeight("w", integers, np.ones(5, np.float32), 0)
    read_blocks(Writer(model.graph), node, cut)
    over_blocks = filter_of_blocks(weight, cut).integers.astype(np.float32)
    model.graph.initializers["w"].const_value = ir.tensor(over_blocks, name="w")
    model.graph.initializers["w"].shape = ir.Shape(over_blocks.shape)

    np.testing.assert_array_equal(ran(model, fed)["y"], want)


@pytest.mark.parametrize(
    "stem",
    [
        Stem(channels=4),
        Stem(height=11),
        Stem(width=7),
        Stem(options="pads=[3,3,3,3]"),
        Stem(options="strides=[2,1], pads=[3,3,3,3]"),
        Stem(options="strides=[2,2], dilations=[2,2], pads=[6,6,6,6]"),
        Stem(channels=1, options='strides=[2,2], auto_pad="SAME_UPPER"'),
        Stem(kernel=3, options="strides=[4,4], pads=[1,1,0,0]"),
    ],
)
def test_what_blocks_do_not_fit_stays(stem: Stem) -> None:
    assert blocks_of(net(stem.text(), {"w": np.ones(stem.filter)}).graph[0]) is None


def test_the_first_layer_of_a_backbone_reads_blocks_in_int8() -> None:
    stem = Stem()
    model, fed = drawn(stem.text(), {"w": stem.filter}), feeds(6, x=stem.image)

    small = calibrated(model, fed)

    found = kernels(small)
    assert found["SpaceToDepth"] == found["QLinearConv"] == 1
    assert sqnr_db(ran(model, fed)["y"], ran(small, fed)["y"]) > 30


def test_a_convolution_between_others_reads_their_uint8() -> None:
    text = """
    narrow (float[1,4,8,8] x, float[3,4,1,1] w1, float[5,3,3,3] w2)
        => (float[1,5,4,4] y) {
        a = Conv(x, w1)
        y = Conv<strides=[2,2], pads=[1,1,1,1]>(a, w2)
    }
    """
    model = drawn(text, {"w1": (3, 4, 1, 1), "w2": (5, 3, 3, 3)})

    found = kernels(calibrated(model, feeds(7, x=(1, 4, 8, 8))))

    assert (found["SpaceToDepth"], found["QLinearConv"]) == (0, 2)
