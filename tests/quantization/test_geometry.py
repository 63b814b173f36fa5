"""Geometry stays float, however its products are batched, and ends where it ends."""

import re
from collections.abc import Mapping

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.quantization.decision import QuantPlan, QuantScheme
from me2e_compress.quantization.plan import make_plan
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.quantization.rules.rule_sets import Geometry
from tests.support.nets import MODULES, by_output, net

HEAD = QuantScheme.of(("head",), MODULES)
OPSETS = '<ir_version: 9, opset_import: ["" : 17, "trt" : 1]>\n'
ALONE = "paper{extra=[geometry], without=[gemv]}"
"""Neither gemv nor small-product takes the product before geometry can."""


def planned(text: str, shapes: Mapping[str, tuple[int, ...]], rules: str) -> QuantPlan:
    weights = {name: np.ones(shape) for name, shape in shapes.items()}
    return make_plan(net(OPSETS + text, weights), HEAD, RULE_SETS.parse(rules))


PRODUCT = "p = MatMul(lidar2img, points)"
PROJECTIONS = {
    "batched": ("float[6,4,4] lidar2img, float[6,4,200] points", PRODUCT),
    "one column a point": ("float[1,6,1,4,4] lidar2img, float[50,4,1] points", PRODUCT),
    "expanded": (
        "float[1,6,4,4] lidar2img, float[1,6,50,4,1] points",
        "u = Unsqueeze(lidar2img, two) e = Expand(u, all) p = MatMul(e, points)",
    ),
    "cameras stacked in rows": (
        "float[1,6,4,4] lidar2img, float[4,200] points",
        "m = Reshape(lidar2img, flat) p = MatMul(m, points)",
    ),
    "transposed": (
        "float[6,4,4] lidar2img, float[6,4,4] ego",
        "t = Transpose<perm = [0,2,1]>(lidar2img) p = MatMul(t, ego)",
    ),
    "of many points": ("float[6,4,4] lidar2img, float[4,40000] points", PRODUCT),
    "as Gemm": (
        "float[4,4] ego_pose, float[200,4] points",
        "p = Gemm<transB = 1>(ego_pose, points)",
    ),
    "of an open number of cameras": (
        "float[C,4,4] lidar2img, float[4,200] points",
        PRODUCT,
    ),
    "of an unknown shape": ("float lidar2img, float[4,200] points", PRODUCT),
    "inverted": (
        "float[6,4,4] lidar2img, float[4,200] points",
        "i = trt.InverseTRT(lidar2img) p = MatMul(i, points)",
    ),
}


def projection(case: str) -> ir.Model:
    """Build it; the points, and where the ego is, are weights."""
    inputs, body = PROJECTIONS[case]
    weights = {
        name: np.ones([int(side) for side in sides.split(",")])
        for sides, name in re.findall(r"float\[([\d,]+)\] (points|ego)\b", inputs)
    }
    constants = (
        "int64[1] two = {2}, int64[5] all = {1,6,50,4,4}, int64[2] flat = {24,4}"
    )
    return net(f"{OPSETS}c ({inputs}) => (float p) <{constants}> {{ {body} }}", weights)


@pytest.mark.parametrize("case", PROJECTIONS)
def test_a_projection_stays_float_however_it_is_batched(case: str) -> None:
    before, found = (
        by_output(make_plan(projection(case), HEAD, RULE_SETS.parse(rules)))["p"]
        for rules in ("paper{without=[gemv]}", ALONE)
    )

    assert before.dtype == "int8"
    assert (found.dtype, found.rule) == ("float", "geometry")
    assert "the input " in found.reason


@pytest.mark.parametrize("seed", range(20))
def test_no_batching_of_a_projection_is_int8(seed: int) -> None:
    """Cameras, points, axes in between and sides drawn at random."""
    draw = np.random.default_rng(seed)
    cameras, points = int(draw.integers(1, 9)), int(draw.integers(1, 5000))
    ones = [1] * int(draw.integers(0, 3))
    matrix, columns = [cameras, *ones, 4, 4], [4, points]
    if draw.random() < 0.5:
        columns = [cameras, *ones, *columns]
    text = (
        f"c (float{matrix} camera, float{columns} points) => (float p)"
        " { m = Identity(camera) p = MatMul(m, points) }"
    )
    found = by_output(planned(text, {"points": tuple(columns)}, ALONE))["p"]

    assert (found.dtype, found.rule) == ("float", "geometry")


BEHIND = """c (float[1,6,4,4] lidar2img, float[1,6,32,9,9] image, float[4,200] points,
    float[32,32] w, float[32,32] v, float[2,32] embed) => (float y, float s)
    <int64[1] first = {0}, int64[1] second = {2}, int64[1] axis = {2},
     int64[4] map = {6, 32, 9, 9}, int64[4] cells = {6, 10, 20, 2}> {
    p = MatMul(lidar2img, points)
    pixels = Slice(p, first, second, axis)
    places = Transpose<perm = [0,1,3,2]>(pixels)
    grid = Reshape(places, cells)
    features = Reshape(image, map)
    sampled = GridSample(features, grid)
    rows = Transpose<perm = [0,2,3,1]>(sampled)
    h = MatMul(rows, w)
    e = MatMul(places, embed)
    r = Relu(e)
    y = MatMul(r, v)
    waves = Sin(places)
    s = MatMul(waves, embed)
}"""
LEARNED = {"points": (4, 200), "w": (32, 32), "v": (32, 32), "embed": (2, 32)}


FLAT = """c (float[6,4,4] lidar2img, float[16,64] w, float[64,64] v) => (float y)
    <int64[2] flat = {6, 16}> {
    f = Reshape(lidar2img, flat) a = MatMul(f, w) r = Relu(a) y = MatMul(r, v)
}"""
PIXELS = """c (float[6,4,4] lidar2img, float[6,50,32] query, float[32,3] to_points,
    float[6,50,1] one, float[4,32] embed, float[32,32] w) => (float y) {
    l = MatMul(query, to_points) h = Concat<axis = 2>(l, one)
    t = Transpose<perm = [0,2,1]>(h) p = MatMul(lidar2img, t)
    rows = Transpose<perm = [0,2,1]>(p) e = MatMul(rows, embed)
    both = Add(e, query) y = MatMul(both, w)
}"""


@pytest.mark.parametrize(
    ("text", "shapes", "rules"),
    [
        (
            BEHIND,
            LEARNED,
            {
                "p": "geometry",  # the projection
                "h": "layer",  # reads what was sampled there
                "e": "geometry",  # reads pixels
                "y": "layer",  # reads what the layer before made of them
                "s": "layer",  # reads sines
            },
        ),
        # an encoder of flat matrices is the last to read them
        (FLAT, {"w": (16, 64), "v": (64, 64)}, {"a": "geometry", "y": "layer"}),
        # learned points become pixels and end in the layer that reads them
        (
            PIXELS,
            {"to_points": (32, 3), "embed": (4, 32), "w": (32, 32)},
            {"l": "layer", "p": "weight", "e": "geometry", "y": "layer"},
        ),
    ],
)
def test_where_geometry_ends(
    text: str, shapes: dict[str, tuple[int, ...]], rules: dict[str, str]
) -> None:
    found = by_output(planned(text, shapes, ALONE))

    assert {name: found[name].rule for name in rules} == rules


@pytest.mark.parametrize(
    "input_", ["float[1,256,4,4] memory", "float[6,4,40] camera", "int64[6,4,4] ids"]
)
def test_other_inputs_are_no_matrices(input_: str) -> None:
    kind, name = input_.split()
    columns = kind.rstrip("]").split(",")[-1]
    text = (
        f"c ({input_}, float[{columns},200] w) => (float y)"
        f" {{ f = Cast<to = 1>({name}) y = MatMul(f, w) }}"
    )
    found = by_output(planned(text, {"w": (int(columns), 200)}, ALONE))

    assert found["y"].rule == "layer"


@pytest.mark.parametrize(
    "text",
    [  # of a known size they are points, else matrices
        "c (float[B,50,3] ref_pts, float[3,3] w, float[3,32] v) => (float y)"
        " { a = MatMul(ref_pts, w) y = MatMul(a, v) }",
        "c (float[6,4,C] lidar2img, float[4,200] w, float[4,32] v) => (float y)"
        " { p = MatMul(lidar2img, w) a = Transpose<perm=[0,2,1]>(p) y = MatMul(a, v) }",
    ],
)
def test_named_inputs_of_other_sizes_are_geometry_in_the_layer_behind(
    text: str,
) -> None:
    sides = re.findall(r"float\[([\d,]+)\] ([wv])\b", text)
    shapes = {name: tuple(map(int, side.split(","))) for side, name in sides}
    assert by_output(planned(text, shapes, ALONE))["y"].rule == "geometry"


def test_the_default_keeps_geometry_in_float() -> None:
    rules = RULE_SETS.parse("safe").rules()

    assert Geometry() in rules
    plan = make_plan(projection("batched"), HEAD)
    assert (plan.rules, by_output(plan)["p"].rule) == ("safe", "geometry")
