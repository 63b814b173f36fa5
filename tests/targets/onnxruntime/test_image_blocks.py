import dataclasses

import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from me2e_compress.targets.onnxruntime.lower import (
    blocks_of,
    filter_of_blocks,
    read_blocks,
)
from me2e_compress.targets.weights import QuantizedWeight
from me2e_compress.targets.writer import Writer
from tests.nets import net
from tests.profiles import scaled
from tests.targets.onnxruntime.lowered import (
    calibrated,
    drawn,
    feeds,
    kernels,
    ran,
    sqnr_db,
)

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
