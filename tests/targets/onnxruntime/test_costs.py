"""What onnxruntime's CPU is faster with, by its cost model."""

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.quantization.plan import QuantPlan, make_plan
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.quantization.scheme import QuantScheme
from me2e_compress.targets.onnxruntime import OnnxRuntime
from tests.nets import MODULES, net

HEAD = QuantScheme.of(("head",), MODULES)


def planned(text: str, weights: dict[str, tuple[int, ...]]) -> QuantPlan:
    arrays = {name: np.ones(shape) for name, shape in weights.items()}
    model = net(f'<ir_version: 9, opset_import: ["" : 17]>\n{text}', arrays)
    rules = RULE_SETS.parse("paper{extra=[cost]}")
    return make_plan(model, HEAD, rules, costs=OnnxRuntime().costs)


def convolution(channels: int, side: int, kernel: int, group: int) -> QuantPlan:
    shape, edge = (channels, channels // group, kernel, kernel), kernel // 2
    inner = ",".join(map(str, shape))
    return planned(
        f"c (float[1,{channels},{side},{side}] x, float[{inner}] w)"
        f" => (float[1,{channels},{side},{side}] y)"
        f" {{ y = Conv<group={group}, pads=[{edge},{edge},{edge},{edge}]>(x, w) }}",
        {"w": shape},
    )


@pytest.mark.parametrize(
    ("channels", "side", "kernel", "group", "dtype"),
    [
        (64, 56, 3, 1, "int8"),  # measured alone: 1029 µs in float, 330 in int8
        (256, 14, 1, 1, "int8"),  # 125, 48
        (64, 56, 3, 64, "float"),  # 72, 109
        (32, 112, 3, 32, "float"),  # 129, 248
    ],
)
def test_convolutions(
    channels: int, side: int, kernel: int, group: int, dtype: str
) -> None:
    (decision,) = convolution(channels, side, kernel, group).decisions

    assert decision.dtype == dtype
    assert decision.rule == ("layer" if dtype == "int8" else "cost")


@pytest.mark.parametrize(
    ("image", "conv", "weight", "rule"),
    [
        # an image of three channels is copied too often: 91 µs, 303
        ("1,3,224,224", "strides=[2,2]", (16, 3, 3, 3), "cost"),
        # open shapes are not judged
        ("n,64,56,56", "group=64", (64, 1, 3, 3), "layer"),
    ],
)
def test_convolutions_that_read_little(
    image: str, conv: str, weight: tuple[int, ...], rule: str
) -> None:
    shape = ",".join(map(str, weight))
    text = f"c (float[{image}] x, float[{shape}] w) => (float[a,b,c,d] y)"
    plan = planned(f"{text} {{ y = Conv<{conv}>(x, w) }}", {"w": weight})

    assert [each.rule for each in plan.decisions] == [rule]


@pytest.mark.parametrize(("rows", "rule"), [(1000, "layer"), (10, "cost")])
def test_narrow_products(rows: int, rule: str) -> None:
    inner, columns = (256, 256) if rule == "layer" else (4000, 2)
    plan = planned(
        f"p (float[{rows},{inner}] x, float[{inner},{columns}] w)"
        f" => (float[{rows},{columns}] y) {{ y = MatMul(x, w) }}",
        {"w": (inner, columns)},
    )

    assert [each.rule for each in plan.decisions] == [rule]


def test_depthwise_between_convolutions_stays_int8() -> None:
    plan = planned(
        """s (float[1,96,28,28] x, float[96,96,1,1] a, float[96,1,3,3] d,
              float[96,96,1,1] b) => (float[1,96,28,28] y) {
            p = Conv(x, a)
            q = Relu(p)
            r = Conv<group=96, pads=[1,1,1,1]>(q, d)
            s = Relu(r)
            y = Conv(s, b)
        }""",
        {"a": (96, 96, 1, 1), "d": (96, 1, 3, 3), "b": (96, 96, 1, 1)},
    )

    assert [each.output for each in plan.chosen] == ["p", "r", "y"]


def test_a_shared_input_is_quantized_once() -> None:
    model = net(
        "p (float[64,64] x, float[64,64] v, float[64,64] w)"
        " => (float[64,64] y, float[64,64] z) { y = MatMul(x, v)\n z = MatMul(x, w) }",
        {"v": np.ones((64, 64)), "w": np.ones((64, 64))},
    )
    layers: list[ir.Node] = list(model.graph)
    costs = OnnxRuntime().costs(model, layers)

    assert len(costs.borders) == 1
    assert costs.borders[0].readers == frozenset(layers)


@pytest.mark.parametrize(
    ("outputs", "reader", "as_float"),
    [
        ("", "", False),
        (", float[1,4,8,8] p", "", True),
        (", float[1,4,8,8] z", "z = Sigmoid(p)", True),
        (", float[1,4,8,8] p, float[1,4,8,8] z", "z = Sigmoid(p)", True),
    ],
    ids=["a layer alone", "an output", "another operator", "both"],
)
def test_what_is_read_as_float(outputs: str, reader: str, as_float: bool) -> None:
    model = net(
        f"""        c (float[1,4,8,8] x, float[4,4,1,1] w, float[4,4,1,1] v)
            => (float[1,4,8,8] y{outputs}) {{
            p = Conv(x, w) {reader} y = Conv(p, v)
        }}""",
        {"w": np.ones((4, 4, 1, 1)), "v": np.ones((4, 4, 1, 1))},
    )
    layers: list[ir.Node] = [n for n in model.graph if n.op_type == "Conv"]

    borders = OnnxRuntime().costs(model, layers).borders

    (between,) = (each for each in borders if each.makers == {layers[0]})
    assert between.readers == {layers[1]}
    assert between.read_as_float is as_float
