"""What onnxruntime's CPU is faster with, by its cost model."""

from collections import Counter
from collections.abc import Callable

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.operators import kernels
from me2e_compress.quantization.decision import QuantPlan, QuantScheme
from me2e_compress.quantization.plan import make_plan
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.runtime.optimized import optimize
from me2e_compress.targets.onnxruntime import OnnxRuntime
from me2e_compress.targets.onnxruntime.costs import work_of
from tests.support.nets import FULL, MODULES, drawn, net
from tests.targets.onnxruntime.lowered import Feeds, feeds, measured, ran, sqnr_db

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


@pytest.mark.parametrize(("read", "kind"), [(64, "int8_mac"), (66, "int8_uneven_mac")])
def test_channels_that_are_no_multiple_of_four(read: int, kind: str) -> None:
    text = f"c (float[1,{read},8,8] x, float[8,{read},1,1] w) => (float[1,8,8,8] y)"
    model = net(f"{text} {{ y = Conv(x, w) }}", {"w": np.ones((8, read, 1, 1))})
    assert (work_of(model.graph[0]) or ({}, {}))[1][kind] == 8 * 8 * 8 * read


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
    (border,) = OnnxRuntime().costs(model, layers).borders

    assert border.readers == frozenset(layers)


@pytest.mark.parametrize(
    ("outputs", "reader", "times"),
    [
        ("", "", 0),
        (", float[1,4,8,8] p", "", 1),
        (", float[1,4,8,8] z", "z = Sigmoid(p)", 1),
        (", float[1,4,8,8] p, float[1,4,8,8] z", "z = Sigmoid(p)", 2),
    ],
)
def test_what_is_converted_for_float(outputs: str, reader: str, times: int) -> None:
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
    assert between.paid_s(layers) == times * between.dequantize_s
    assert between.paid_s(layers[:1]) == (times + 1) * between.dequantize_s


# Feature maps that fused operators sample: uint8 where the plan says so.


compiled = pytest.mark.skipif(
    kernels.why_not() is not None, reason=str(kernels.why_not())
)
ALL = "paper{without=[fused-operator]}"
PRICED = "paper{without=[fused-operator], extra=[cost]}"
ATTENTION = """
<ir_version: 9, opset_import: ["" : 17, "me2e" : 1]>
net (float[1,ROWS,24] x, float[24,24] w, float[24] b, float[1,QUERIES,3,2,4,2] at,
     float[1,QUERIES,3,2,4] shares) => (float[1,QUERIES,3,8] y)
<int64[4] heads = {1, ROWS, 3, 8}, int32[2,2] sizes = {5, 11, 2, 4},
 int32[2] starts = {0, 55}> {
    ["/head/product"] p = MatMul(x, w)
    ["/head/bias"] s = Add(p, b)
    ["/head/heads"] value = Reshape(s, heads)
    ["/head/sampled"] y =
        me2e.MultiScaleDeformableAttention(value, sizes, starts, at, shares)
}
"""
AGGREGATION = """
<ir_version: 9, opset_import: ["" : 17, "me2e" : 1]>
net (float[1,3,4,6] x, float[12,3,3,3] w1, float[12,12,3,3] w2, float[1,50,5,1,2] at,
     float[1,50,5,1,2,3] shares) => (float[1,50,12] y)
<int64[3] flat = {1, 12, -1}, int32[1,2,2] sizes = {4, 6, 2, 3},
 int32[1,2] starts = {0, 24}> {
    ["/backbone/one"] c1 = Conv<pads=[1,1,1,1]>(x, w1)
    ["/backbone/two"] c2 = Conv<pads=[1,1,1,1], strides=[2,2]>(c1, w2)
    f1 = Reshape(c1, flat)  t1 = Transpose<perm=[0,2,1]>(f1)
    f2 = Reshape(c2, flat)  t2 = Transpose<perm=[0,2,1]>(f2)
    ["/head/maps"] maps = Concat<axis=1>(t1, t2)
    ["/head/sampled"] y = me2e.DeformableAggregation(maps, sizes, starts, at, shares)
}
"""


def attention(rows: int = 63, queries: int = 50) -> ir.Model:
    text = ATTENTION.replace("ROWS", str(rows)).replace("QUERIES", str(queries))
    return drawn(text, {"w": (24, 24), "b": (24,)})


def aggregation() -> ir.Model:
    return drawn(AGGREGATION, {"w1": (12, 3, 3, 3), "w2": (12, 12, 3, 3)})


def fed_to(model: ir.Model) -> Feeds:
    shapes = {
        str(value.name): tuple(value.shape.numpy())
        for value in model.graph.inputs
        if value.shape is not None
    }
    found = dict(feeds(1, **shapes))
    places = np.random.default_rng(2).uniform(0.1, 0.9, shapes["at"])
    found["at"] = places.astype(np.float32)
    return found


def priced(model: ir.Model, rules: str) -> QuantPlan:
    target = OnnxRuntime()
    chosen = RULE_SETS.parse(rules)
    return make_plan(
        model, FULL, chosen, costs=target.costs, fused=target.fused_objection
    )


def quantized(model: ir.Model) -> ir.Model:
    plan = priced(model, ALL)
    ranges = measured(model, OnnxRuntime().tensors(plan, model), fed_to(model))
    return OnnxRuntime().place(model, plan, ranges)


@compiled
@pytest.mark.parametrize("make", [attention, aggregation])
def test_the_kernel_for_uint8_samples_it(make: Callable[[], ir.Model]) -> None:
    model = make()
    found = Counter(node.op_type for node in optimize(quantized(model)).graph)

    assert found["MultiScaleDeformableAttentionUint8"] == 1
    assert found["QGemm"] == 0  # it is slower at writing uint8
    assert found["DequantizeLinear"] == 0


@pytest.mark.parametrize("make", [attention, aggregation])
def test_positions_and_weights_stay_float(make: Callable[[], ir.Model]) -> None:
    model = make()
    small = quantized(model)
    node = next(each for each in small.graph if each.domain == "me2e")
    fed = fed_to(model)

    want, got = ran(model, fed), ran(small, fed)

    assert [str(v.name) for v in node.inputs[3:] if v] == ["at", "shares"]
    assert sqnr_db(want["y"], got["y"]) > 25


@pytest.mark.parametrize(("rows", "rule"), [(30_000, "sampled"), (4_000, "cost")])
def test_a_product_is_sampled_as_uint8_where_it_exceeds_the_cache(
    rows: int, rule: str
) -> None:
    # so few queries that they would not pay for another pass over the rows
    plan = priced(attention(rows=rows, queries=3_000), PRICED)

    assert plan.decisions[-1].rule == rule


def test_maps_that_are_uint8_already_do() -> None:
    plan = priced(aggregation(), PRICED)

    assert plan.decisions[-1].rule == "sampled"
