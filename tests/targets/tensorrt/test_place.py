import importlib.util

import numpy as np
import numpy.typing as npt
import onnx
import onnx_ir as ir
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress import graph
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.graph import array_of, provenance
from me2e_compress.quantization.decision import QuantScheme
from me2e_compress.quantization.plan import make_plan, tensors_of
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.quantization.rules.rule_sets import SafeRules
from me2e_compress.runtime.session import Session, run_once
from me2e_compress.targets.tensorrt import TensorRT
from me2e_compress.targets.tensorrt.rtx_check import check
from tests.support import nets
from tests.support.nets import FULL, MODULES, conv_attention, drawn, net
from tests.support.profiles import scaled
from tests.targets.tensorrt.layers import SHAPES, layers

PARTS = ("int8", "scale", "zero")
AXES = {"conv": 0, "up": 1, "right": 1, "turned": 0}


def placed(model: ir.Model, reach: float = 3.0) -> ir.Model:
    return nets.placed(model, ends=(-reach, reach / 2))


def test_weights_are_stored_as_int8_along_their_channels() -> None:
    model = placed(layers())
    stored = model.graph.initializers
    producers = {
        node.inputs[0].name: node
        for node in model.graph
        if node.op_type == "DequantizeLinear" and node.inputs[0] is not None
    }

    for name, axis in AXES.items():
        assert name not in stored
        assert stored[f"{name}_int8"].dtype == ir.DataType.INT8
        assert graph.static_shape(stored[f"{name}_int8"]) == SHAPES[name]
        assert graph.static_shape(stored[f"{name}_scale"]) == (SHAPES[name][axis],)
        assert producers[f"{name}_int8"].attributes["axis"].as_int() == axis
    assert stored["bias"].dtype == ir.DataType.FLOAT
    # readers of a tensor share one pair
    pairs = [n.inputs[0] for n in model.graph if n.op_type == "QuantizeLinear"]
    assert sorted(str(value.name) for value in pairs if value) == ["a", "t", "x"]


def test_the_result_is_a_valid_graph_and_the_source_untouched() -> None:
    model = conv_attention()
    before = graph.digest(model)

    result = placed(model)

    onnx.checker.check_model(ir.to_proto(result), full_check=True)
    assert graph.digest(model) == before
    assert not provenance.missing(result)
    for node in result.graph:
        past = provenance.read(node)
        assert past is not None
        if node.op_type in ("QuantizeLinear", "DequantizeLinear"):
            assert past.passes == ("quantize-int8",)
            reader = next(iter(node.outputs[0].consumers()))
            assert past.module == provenance.module_of(reader)


Floats = npt.NDArray[np.float32]


def fake_quantized(x: Floats, scale: Floats) -> npt.NDArray[np.float64]:
    """Round in float32, as QuantizeLinear is defined; all else is float64."""
    steps = np.clip(np.rint(x / scale), -128, 127).astype(np.float64)
    return np.asarray(steps * scale.astype(np.float64))


@settings(max_examples=scaled(20))
@given(seed=st.integers(0, 2**32 - 1), reach=st.floats(0.5, 8.0))
def test_numbers_are_those_of_rounding_both_operands(seed: int, reach: float) -> None:
    model = layers(seed)
    generator = np.random.default_rng(seed)
    t = generator.standard_normal((2, 4)).astype(np.float32)
    stored = graph.array_of(model.graph.initializers["right"])
    assert stored is not None
    right = stored.astype(np.float32)
    x = np.zeros((2, 3, 5, 5), np.float32)

    got = run_once(placed(model, reach), {"x": x, "t": t})["c"].astype(np.float64)

    step = np.array(reach / 127, np.float32)
    channels = np.abs(right).max(axis=0) / np.float32(127)
    want = fake_quantized(t, step) @ fake_quantized(right, channels)
    np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("reader", "left"), [("z = MatMul(y, w)", set()), ("z = Relu(w)", {"w"})]
)
def test_a_weight_two_layers_share_is_stored_once_and_stays_where_it_is_read_in_float(
    reader: str, left: set[str]
) -> None:
    text = f"""
    tied (float[4,4] x, float[4,4] w) => (float[4,4] y, float[4,4] z) {{
        y = MatMul(x, w)
        {reader}
    }}
    """
    model = placed(net(text, {"w": np.ones((4, 4))}))

    stored = {name for name in model.graph.initializers if name.endswith("_int8")}
    assert stored == {"w_int8"}
    assert {"w"} & set(model.graph.initializers) == left


BLOCK = """
block (float[1,4,5,5] x, float[4,4,3,3] w, float[4,4,1,1] v) => (float[1,4,5,5] y) {
    r = Relu(x)
    a = Conv<kernel_shape=[3,3], pads=[1,1,1,1]>(r, w)
    s = Add(a, %s)
    y = Relu(s)
}
"""


@pytest.mark.parametrize("branch", ["x", "r"])
def test_only_the_residual_branch_of_an_add_is_quantized(branch: str) -> None:
    weights = {"w": np.ones((4, 4, 3, 3)), "v": np.ones((4, 4, 1, 1))}
    model = placed(net(BLOCK % branch, weights))

    (add,) = (node for node in model.graph if node.op_type == "Add")
    makers = [value.producer() for value in add.inputs if value is not None]
    assert [node.op_type for node in makers if node] == ["Conv", "DequantizeLinear"]
    pairs = [n.op_type for n in model.graph].count("QuantizeLinear")
    assert pairs == (1 if branch == "r" else 2)  # its other readers share a pair


@pytest.mark.parametrize(("wide", "shared"), [(4.0, True), (4.1, False)])
def test_what_a_concat_joins_is_on_one_scale_unless_it_is_far_smaller(
    wide: float, shared: bool
) -> None:
    text = """
    join (float[9,16] a, float[9,16] b, float[16,16] w, float[32,16] v)
        => (float[9,16] k, float[9,16] m) {
        k = MatMul(a, w)
        ab = Concat<axis=1>(a, b)
        m = MatMul(ab, v)
    }
    """
    model = net(text, {"w": np.ones((16, 16)), "v": np.ones((32, 16))})
    plan = make_plan(model, FULL, SafeRules())
    tensors = {"a": (-1.0, 1.0), "ab": (-1.0, wide)}

    result = TensorRT().place(model, plan, Ranges(tensors, "max-min", 1, "", ""))

    scales = [
        graph.array_of(node.inputs[1])
        for node in result.graph
        if node.op_type == "QuantizeLinear"
    ]
    own = np.float32(wide / 127), np.float32((wide if shared else 1) / 127)
    assert sorted(float(each) for each in scales if each is not None) == sorted(own)


BATCHED = """
batched (float[3,4,32] x, float[2,32] t, float[1,32,16] one, float[3,32,16] many,
         float[1,32,8] lends) => (float[3,4,16] a, float[3,4,16] b, float[1,2,8] c) {
    a = MatMul(x, one)
    b = MatMul(x, many)
    c = MatMul(t, lends)
}
"""


def batched() -> ir.Model:
    shapes = {"one": (1, 32, 16), "many": (3, 32, 16), "lends": (1, 32, 8)}
    return drawn(BATCHED, shapes, 5)


def test_one_matrix_has_scales_by_column_and_a_batch_of_them_one_scale() -> None:
    stored = placed(batched()).graph.initializers

    shapes = {
        name: tuple(graph.static_shape(stored[f"{name}_{what}"]) for what in PARTS)
        for name in ("one", "many", "lends")
    }
    assert shapes == {
        "one": ((32, 16), (16,), (16,)),
        "many": ((3, 32, 16), (), ()),
        "lends": ((1, 32, 8), (), ()),
    }


# Plugins that take int8 features, and their scale as one more input.


SPARSE_DRIVE_V2 = """
<ir_version: 9, opset_import: ["" : 17, "sparsedrivev2" : 1]>
net (float[1,30,12] maps, float[1,50,5,1,2] at, float[1,50,5,1,2,3] shares)
    => (float[1,50,12] y)
<int32[1,2,2] sizes = {4, 6, 2, 3}, int32[1,2] starts = {0, 24}> {
    ["/head/sampled"] y =
        sparsedrivev2.DeformableAggregation(maps, sizes, starts, at, shares)
}
"""


def sampled() -> tuple[ir.Model, ir.Model]:
    model, target = net(SPARSE_DRIVE_V2, {}), TensorRT()
    scheme, rules = QuantScheme.of(("head",), MODULES), RULE_SETS.parse("safe")
    plan = make_plan(model, scheme, rules, fused=target.fused_objection)
    ends = dict.fromkeys(tensors_of(plan, model), (-3.0, 2.0))
    return model, target.place(model, plan, Ranges(ends, "max-min", 1, "", ""))


def test_it_gets_integers_and_a_scale_for_every_channel() -> None:
    model, small = sampled()

    assert [node.op_type for node in small.graph] == [
        "QuantizeLinear",
        "DeformableAggregation",
    ]
    maps, *_, scales = small.graph[1].inputs
    assert maps is not None
    assert maps.dtype == ir.DataType.INT8
    numbers = array_of(scales)
    assert numbers is not None
    assert np.allclose(numbers.astype(np.float64), np.full(12, 3 / 127))
    assert TensorRT().lint(small) == ()
    # it computes the same to rounding
    random = np.random.default_rng(0)
    fed = {
        "maps": random.uniform(-3, 2, (1, 30, 12)).astype(np.float32),
        "at": random.uniform(0, 1, (1, 50, 5, 1, 2)).astype(np.float32),
        "shares": random.uniform(0, 1, (1, 50, 5, 1, 2, 3)).astype(np.float32),
    }
    want, got = (
        Session(each, threads=1).run(fed)["y"].astype(np.float64)
        for each in (model, small)
    )
    assert 0 < np.abs(got - want).max() < 0.02 * np.abs(want).max()


@pytest.mark.skipif(
    importlib.util.find_spec("tensorrt_rtx") is None, reason="extra trt-check"
)
def test_tensorrts_parser_takes_all_but_the_plugin() -> None:
    found = check(sampled()[1], build=False)

    assert found.passed
    assert found.cut == ("/head/sampled",)
