"""The rules beyond the paper's two stages."""

import numpy as np
import pytest

from me2e_compress.base.errors import RecipeError
from me2e_compress.quantization.decision import Decision, QuantScheme
from me2e_compress.quantization.plan import make_plan
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.targets.onnxruntime import OnnxRuntime
from me2e_compress.targets.tensorrt import TensorRT
from tests.support.nets import MODULES, by_output, net, planned

HEAD = QuantScheme.of(("head",), MODULES)
OPSETS = '<ir_version: 9, opset_import: ["" : 17, "trt" : 1]>\n'


def test_no_such_rule_set() -> None:
    with pytest.raises(RecipeError, match="no rule set 'nvidia'; there are safe"):
        RULE_SETS.parse("nvidia")


def test_rules_can_be_switched_off_one_by_one() -> None:
    left = RULE_SETS.parse("safe{without=[gemv, coordinates]}")

    assert [rule.name for rule in left.rules()] == [
        "operator", "module", "weight", "geometry", "ego-input", "attention-length",
        "attention-weights", "small-product", "narrow-convolution",
        "size", "cost",
    ]  # fmt: skip


@pytest.mark.parametrize("name", ["weight", "speed"])
def test_other_rules_cannot(name: str) -> None:
    with pytest.raises(RecipeError, match=f"rule {name} cannot be switched off; of pa"):
        RULE_SETS.parse(f"paper{{without=[{name}]}}").rules()


@pytest.mark.parametrize(
    ("shape", "rule"),
    [((16, 16), "layer"), ((15, 64), "small-product"), ((64, 15), "small-product")],
)
def test_products_below_one_tile_stay_float(shape: tuple[int, int], rule: str) -> None:
    text = OPSETS + (
        f"p (float[9,{shape[0]}] x, float[{shape[0]},{shape[1]}] w)"
        f" => (float[9,{shape[1]}] y) {{ y = MatMul(x, w) }}"
    )
    plan = planned(net(text, {"w": np.ones(shape)}))

    assert by_output(plan)["y"].rule == rule


@pytest.mark.parametrize(
    ("image", "weight", "more", "rules"),
    [
        ("1,2048", (2048, 64), 16, ("layer", "gemv")),
        # too few weights of the model's, or at all; TensorRT reads none faster
        ("1,2048", (2048, 64), 640, ("gemv", "gemv")),
        ("1,512", (512, 64), 16, ("gemv", "gemv")),
        # a convolution of one pixel; of two it is none
        ("1,512,1,1", (64, 512, 1, 1), 16, ("gemv", "layer")),
        ("1,512,1,2", (64, 512, 1, 1), 16, ("layer", "layer")),
        ("1,1024,1,1", (64, 1024, 1, 1), 640, ("layer", "layer")),
    ],
)
def test_one_row_is_int8_for_onnxruntime_where_its_weights_are_many(
    image: str, weight: tuple[int, ...], more: int, rules: tuple[str, str]
) -> None:
    layer = "MatMul" if len(weight) == 2 else "Conv"
    text = OPSETS + (
        f"p (float[{image}] x, float{[*weight]} w, float[64,64,{more}] v)"
        f" => (float y, float z) {{ y = {layer}(x, w) z = ReduceMax<axes=[2]>(v) }}"
    ).replace(': 17, "trt"', ': 13, "trt"')
    model = net(text, {"w": np.ones(weight), "v": np.ones((64, 64, more))})

    for target, rule in zip((OnnxRuntime(), TensorRT()), rules, strict=True):
        plan = make_plan(model, HEAD, costs=target.costs)
        assert by_output(plan)["y"].rule == rule


@pytest.mark.parametrize(
    ("made", "rule"),
    [
        ("t = MatMul(a, w) z = MatMul(b, w)", "layer"),  # stored once, read twice
        ("t = MatMul(a, w) z = Gather(w, i)", "size"),
        ("t = MatMul(a, w) z = MatMul(x, w)", "size"),  # of one row, in float
        ("v = Transpose(w) t = MatMul(a, v) z = Relu(b)", "layer"),
        ("v = Transpose(w) t = MatMul(a, v) z = Gather(w, i)", "size"),
        ("v = Expand(s, d) t = MatMul(a, v) z = Relu(b)", "size"),
    ],
)
def test_int8_that_would_make_the_file_larger_stays_float(made: str, rule: str) -> None:
    text = (
        OPSETS
        + f"""
    p (float[9,32] a, float[9,32] b, float[1,32] x, int64[4] i, float[32,32] w,
       float[32,1] s) => (float[9,32] t, float[n,32] z) <int64[2] d = {{32, 32}}>
    {{ {made} }}"""
    )
    model = net(text, {"w": np.ones((32, 32)), "s": np.ones((32, 1))})

    assert by_output(make_plan(model, HEAD))["t"].rule == rule


@pytest.mark.parametrize(
    ("weight", "group", "behind", "rule"),
    [
        # outputs, inputs a group, kernel; behind another layer or at the image
        ((64, 3, 7, 7), 1, False, "layer"),
        ((64, 3, 7, 7), 1, True, "layer"),
        ((8, 3, 3, 3), 1, False, "layer"),
        ((8, 3, 3, 3), 1, True, "narrow-convolution"),
        ((64, 3, 1, 3), 1, False, "narrow-convolution"),
        ((12, 12, 3, 3), 1, False, "narrow-convolution"),
        ((16, 16, 1, 1), 1, True, "layer"),
        ((32, 1, 3, 3), 32, True, "layer"),
        ((32, 1, 1, 1), 32, True, "narrow-convolution"),
        ((36, 1, 3, 3), 36, True, "narrow-convolution"),
    ],
)
def test_narrow_convolutions(
    weight: tuple[int, ...], group: int, behind: bool, rule: str
) -> None:
    channels = weight[1] * group
    text = OPSETS + (
        f"c (float[1,{channels},9,9] x, float{list(weight)} w)"
        f" => (float[1,{weight[0]},H,W] y) {{ r = Relu(x)"
        f" y = Conv<group={group}>({'r' if behind else 'x'}, w) }}"
    )
    plan = planned(net(text, {"w": np.ones(weight)}))

    assert by_output(plan)["y"].rule == rule


def test_deconvolutions_count_channels_the_other_way_round() -> None:
    text = OPSETS + (
        "c (float[1,64,9,9] x, float[64,4,1,3] w) => (float[1,4,H,W] y)"
        " { r = Relu(x) y = ConvTranspose(r, w) }"
    )
    (found,) = (
        each
        for each in planned(net(text, {"w": np.ones((64, 4, 1, 3))})).decisions
        if each.output == "y"
    )

    assert found.rule == "narrow-convolution"
    assert "64 to 4 channels" in found.reason


SAMPLING = (
    OPSETS
    + """
sampling (float[1,50,32] query, float[1,50,1,2] reference, float[1,16,9,9] value,
          float[32,16] offsets, float[16] b, float[32,16] weights, float[32,32] ffn)
    => (float[1,16,50,8] y, float[1,50,32] z)
    <int64[4] points = {1, 50, 8, 2}, int64[4] each = {1, 50, 8, 2},
     float two = {2.0}, float one = {1.0}> {
    o = MatMul(query, offsets)
    ob = Add(o, b)
    o2 = Reshape(ob, points)
    location = Add(reference, o2)
    doubled = Mul(location, two)
    grid = Sub(doubled, one)
    w = MatMul(query, weights)
    w2 = Reshape(w, each)
    p = Softmax(w2)
    %s
    z = MatMul(query, ffn)
}
"""
)
SIZES = {"offsets": (32, 16), "b": (16,), "weights": (32, 16), "ffn": (32, 32)}
ONNX = "y = GridSample(value, grid)"
PLUGIN = "y = trt.MultiscaleDeformableAttnPlugin_TRT(value, value, value, grid, p)"


@pytest.mark.parametrize("sampler", [ONNX, PLUGIN])
def test_offsets_and_their_weights_stay_float(sampler: str) -> None:
    model = net(SAMPLING % sampler, {n: np.ones(s) for n, s in SIZES.items()})

    found = by_output(planned(model))

    assert (found["o"].dtype, found["o"].rule) == ("float", "coordinates")
    assert "come from it" in found["o"].reason
    assert (found["w"].dtype, found["w"].rule) == ("float", "coordinates")
    assert "the offsets read" in found["w"].reason
    assert (found["z"].dtype, found["z"].rule) == ("int8", "layer")


def test_the_paper_knows_no_coordinates() -> None:
    model = net(SAMPLING % ONNX, {n: np.ones(s) for n, s in SIZES.items()})

    assert planned(model, "paper").counts() == {"layer": 3}


@pytest.mark.parametrize(
    "reader",
    [
        "at = Floor(s) i = Cast<to=7>(at) y = Gather<axis=0>(table, i)",
        "c = Cos(s) n = Reshape(c, square) m = trt.InverseTRT(n) y = MatMul(m, other)",
    ],
)
def test_what_is_looked_up_or_inverted_is_a_position(reader: str) -> None:
    text = f"""{OPSETS}
    points (float[16,32] x, float[32,16] w, float[99,2] table, float[16,16] other)
        => (float y) <int64[2] square = {{16, 16}}> {{
        l = MatMul(x, w)
        s = Sigmoid(l)
        {reader}
    }}
    """
    found = by_output(planned(net(text, {"w": np.ones((32, 16))})))

    assert found["l"].rule == "coordinates"


ROTATION = (
    OPSETS
    + """
rotation (float[8,32] scene, float[32,32] shift, float[2,32] ego, float[32,16] turn,
          float[32,16] middle) => (float[8,32] y) {
    i = MatMul(scene, shift)
    a = MatMul(ego, turn)
    radians = Tanh(a)
    c = MatMul(ego, middle)
    halves = Sigmoid(c)
    y = trt.%s<interpolation=1>(i, radians, halves)
}
"""
)


@pytest.mark.parametrize("plugin", ["RotateTRT", "RotateTRT2", "RotatePlugin"])
def test_angle_and_centre_of_a_rotation_stay_float(plugin: str) -> None:
    sizes = {"shift": (32, 32), "turn": (32, 16), "middle": (32, 16)}
    model = net(ROTATION % plugin, {n: np.ones(s) for n, s in sizes.items()})

    found = by_output(planned(model))

    reason = f"positions that {plugin} reads come from it"
    assert (found["a"].rule, found["a"].reason) == ("coordinates", reason)
    assert (found["c"].rule, found["c"].reason) == ("coordinates", reason)
    assert (found["i"].dtype, found["i"].rule) == ("int8", "layer")


def test_a_layer_behind_a_layer_is_no_position() -> None:
    """The walk ends at the layer that gives the offsets."""
    text = (
        OPSETS
        + """
    deep (float[1,50,32] x, float[32,32] a, float[32,16] b, float[1,3,9,9] value)
        => (float[1,3,50,8] y) <int64[4] points = {1, 50, 8, 2}> {
        h = MatMul(x, a)
        r = Relu(h)
        o = MatMul(r, b)
        g = Reshape(o, points)
        y = GridSample(value, g)
    }
    """
    )
    weights = {"a": np.ones((32, 32)), "b": np.ones((32, 16))}
    found = by_output(planned(net(text, weights)))

    assert (found["h"].rule, found["o"].rule) == ("layer", "coordinates")


ATTENTION = (
    OPSETS
    + """
attention (float[1,64,32] q, float[1,32,64] k, float[1,64,32] v, float[32,32] w)
    => (float[1,64,32] y) {
    s = MatMul(q, k) p = Softmax(s) m = MatMul(p, v) y = MatMul(m, w)
}"""
)


def test_attention_weights_are_read_in_float() -> None:
    model = net(ATTENTION, {"w": np.ones((32, 32))})

    paper, safe = by_output(planned(model, "paper")), by_output(planned(model))

    assert (paper["s"].rule, paper["m"].rule) == ("attention", "attention")
    assert (safe["s"].rule, safe["m"].rule) == ("attention-weights",) * 2
    assert safe["y"].rule == "layer"


def test_a_layer_that_averages_by_a_softmax_reads_it_in_float() -> None:
    text = OPSETS + (
        "bins (float[64,32] x, float[32,32] w) => (float[64,32] y)"
        " { p = Softmax(x) d = Identity(p) y = MatMul(d, w) }"
    )
    model = net(text, {"w": np.ones((32, 32))})

    assert by_output(planned(model, "paper"))["y"].rule == "layer"
    assert by_output(planned(model))["y"].rule == "attention-weights"


def test_what_turns_points_before_they_are_looked_up_is_a_position_too() -> None:
    """A chain of products of small matrices, made of no input that is a matrix."""
    text = (
        OPSETS
        + """
    turned (float[1,18] can_bus, float[1,3,9,9] value, float[18,16] w,
            float[4,400] cells) => (float[1,3,20,20] y)
        <int64[2] square = {4, 4}, int64[1] axis = {0}, int64[1] zero = {0},
         int64[1] two = {2}, int64[4] grid = {1, 20, 20, 2}> {
        a = MatMul(can_bus, w) c = Cos(a) m = Reshape(c, square)
        p = MatMul(m, cells) q = MatMul(m, p) xy = Slice(q, zero, two, axis)
        t = Transpose(xy) g = Reshape(t, grid) y = GridSample(value, g)
    }
    """
    )
    model = net(text, {"w": np.ones((18, 16)), "cells": np.ones((4, 400))})
    found = by_output(planned(model, "paper{extra=[coordinates], without=[gemv]}"))

    assert (found["p"].rule, found["a"].rule) == ("coordinates", "coordinates")


# Encoders of the ego car's status are known, and stay float by default.


EGO_NET = """ego (float[3,18] can_bus, float[1,3,%d,32] image, float[3,32] memory,
     float[18,32] a, float[32,32] b, float[32,64] c, float[32,32] d,
     float[500,32] grid) => (float y, float z, float memory_out)
    <int64[2] rows = {3, 32}, int64[2] cells = {32, -1}> {
    e = MatMul(can_bus, a)
    r = Relu(e)
    f = MatMul(r, b)
    m = MatMul(memory, d)
    memory_out = Identity(m)
    pixels = Reshape(image, cells)
    s = MatMul(f, pixels)
    first = ReduceMean<axes = [0], keepdims = 1>(f)
    map = Add(first, grid)
    y = MatMul(map, c)
    i = ReduceMean<axes = [2, 3], keepdims = 0>(image)
    t = ReduceMean<keepdims = 1>(i)
    k = Add(f, t)
    z = MatMul(k, c)
}"""
EGO_SIZES = {
    "a": (18, 32),
    "b": (32, 32),
    "c": (32, 64),
    "d": (32, 32),
    "grid": (500, 32),
}


def decisions(height: int, rule_set: str) -> dict[str, Decision]:
    model = net(
        EGO_NET % height, {name: np.ones(size) for name, size in EGO_SIZES.items()}
    )
    return by_output(planned(model, rule_set))


def rules(height: int, rule_set: str) -> dict[str, str]:
    return {name: each.rule for name, each in decisions(height, rule_set).items()}


@pytest.mark.parametrize(
    ("output", "rule", "why"),
    [
        ("e", "ego-input", "it sees the status alone"),
        ("f", "ego-input", "it sees the status alone"),
        ("m", "layer", "a memory is no status"),
        ("y", "layer", "a map that the status was added to is a map"),
        ("z", "layer", "it sees the image too"),
    ],
)
def test_layers_that_see_the_status_alone_stay_float(
    output: str, rule: str, why: str
) -> None:
    assert rules(32, "safe")[output] == rule, why
    assert rules(1, "safe")["e"] == "layer"  # without sensors there is no status
