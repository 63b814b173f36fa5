"""Deformable attention that is written out becomes one proven node, or stays."""

import dataclasses
import math
from typing import Any

import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.graph import digest, infer_shapes, opset_of, provenance, static_shape
from me2e_compress.operators import expand
from me2e_compress.operators.deformable_attention import DeformableAttention
from me2e_compress.passes import fuse_operators
from me2e_compress.passes.base import PassResult
from me2e_compress.passes.fuse_operators import FuseOperators
from tests.passes.decomposed import FUSED, Sizes, decomposed, inferred, plain
from tests.passes.small import NO_MODULES, apply, compute, fed, ops, read
from tests.support.profiles import scaled

SEED = 3


def fused(model: ir.Model) -> PassResult:
    """Fuse; the outputs stay within 1e-4 of their largest, the node as its body."""
    before = compute(model, fed(model, SEED))
    result = apply(FuseOperators(), model)
    whole = model.clone()
    for node in [node for node in whole.graph if node.domain == "me2e"]:
        expand(node, opset=opset_of(whole), by="test")
    for want, got in zip(before, compute(whole, fed(model, SEED)), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-4 * np.abs(want).max())
    return result


def attention(model: ir.Model) -> ir.Node:
    (node,) = (node for node in model.graph if node.domain == "me2e")
    assert node.op_type == FUSED
    return node


FORMS = {
    "mmcv, two levels": decomposed(Sizes()),
    "one level": decomposed(Sizes(levels=((5, 7),))),
    "one image, one head": decomposed(Sizes(n=1, m=1)),
    "dynamo": decomposed(Sizes(), opset=20, mode="linear", split=True),
    "levels alike": decomposed(Sizes(levels=((4, 4), (4, 4), (4, 4)))),
}


@pytest.mark.parametrize("model", FORMS.values(), ids=FORMS)
def test_what_exporters_write_is_one_node(model: ir.Model) -> None:
    result = fused(model)
    assert result.notes[0].startswith("fused: 1 deformable")
    assert ops(model) == [FUSED, "Reshape"]  # nothing is moved to feed it
    names = [value.name for value in attention(model).inputs if value is not None]
    assert names[::3] == ["value", "locations"]
    *_, worst, _, _, _ = result.notes[0].split()  # ... apart at most
    assert float(worst) < 1e-5


def test_it_stands_for_all_that_it_was() -> None:
    model = decomposed(Sizes())
    names = {node.name for node in model.graph}
    fused(model)
    past = provenance.read(attention(model))
    assert past is not None
    assert past.passes == ("fuse-operators",)
    assert set(past.origins) == names


@settings(max_examples=scaled(12))
@given(
    st.builds(
        Sizes,
        n=st.integers(1, 3),
        q=st.integers(1, 4),
        m=st.integers(1, 4),
        p=st.integers(1, 3),
        d=st.integers(1, 5),
        levels=st.lists(
            st.tuples(st.integers(1, 5), st.integers(1, 5)), min_size=1, max_size=3
        ).map(tuple),
    ),
    st.booleans(),
    st.sampled_from(["", "ReduceSum", "ReduceMean"]),
)
def test_any_sizes(sizes: Sizes, split: bool, merge: str) -> None:
    fused(decomposed(sizes, split=split, merge=merge, masked=bool(merge) and split))


@pytest.mark.parametrize("merge", ["ReduceSum", "ReduceMean"])
@pytest.mark.parametrize("masked", [False, True])
def test_images_that_are_added_up_are_levels(merge: str, masked: bool) -> None:
    sizes = Sizes(n=3)
    model = decomposed(sizes, merge=merge, masked=masked)
    fused(model)
    assert merge not in ops(model)
    shapes = [value.shape for value in attention(model).inputs if value is not None]
    levels = sizes.n * len(sizes.levels)
    assert shapes[0] == (1, sizes.n * sizes.pixels, sizes.m, sizes.d)
    assert shapes[1] == (levels, 2)
    assert shapes[3] == (1, sizes.q, sizes.m, levels, sizes.p, 2)


SUM_OF_HEADS = """g (float[6,4,5,7] image, float[6,9,3,2] grid, float[3] weights)
  => (float[2,4,9] y) <int64[1] last = {-1}, int64[4] apart = {2, 3, 4, 9},
     int64[1] second = {1}> {
    s = GridSample(image, grid)
    m = Mul(s, weights)
    r = ReduceSum<keepdims = 0>(m, last)
    h = Reshape(r, apart)
    y = ReduceSum<keepdims = 0>(h, second)
}"""


POINTS = """<ir_version: 9, opset_import: ["" : 17]>
g (float[2,35,4] value, float[2,9,1,2] at, float[1,9,3,2] offsets, float[2,9,3] weights,
   float[2,9,1] mask) => (float[9,4] y) <float two = {2.0}, float one = {1.0},
     int64[4] map = {2, 4, 5, 7}, int64[4] alone = {2, 1, 9, 3}, int64[1] last = {-1},
     int64[1] first = {0}> {
    t = Transpose<perm = [0, 2, 1]>(value)
    image = Reshape(t, map)
    places = Add(at, offsets)
    a = Mul(places, two)
    grid = Sub(a, one)
    s = GridSample(image, grid)
    w = Reshape(weights, alone)
    m = Mul(s, w)
    r = ReduceSum<keepdims = 0>(m, last)
    e = Transpose<perm = [0, 2, 1]>(r)
    seen = Mul(e, mask)
    y = ReduceSum<keepdims = 0>(seen, first)
}"""


def test_reference_points_are_moved_before_they_are_repeated() -> None:
    model = read(POINTS)
    fused(model)
    moved = [node for node in model.graph if node.op_type == "Transpose"]
    sizes = [math.prod(static_shape(node.outputs[0]) or ()) for node in moved]
    # at, weights, mask; the sum of at and offsets has 108
    assert sorted(sizes) == [2 * 9, 2 * 9 * 2, 2 * 9 * 3]


@pytest.mark.parametrize(
    "model",
    [
        *(
            plain(weights=weights, keep=1)  # weights are repeated
            for weights in ("float[6,1,9,3]", "float[1,1,9,3]", "float[3]")
        ),
        plain(axes=(2, 3)),  # points in two dimensions
        plain(),  # a grid is taken to positions
        read(SUM_OF_HEADS),  # a sum over some of the batch
    ],
)
def test_other_forms_of_it(model: ir.Model) -> None:
    sums = ops(model).count("ReduceSum")
    fused(model)
    assert FUSED in ops(model)
    assert ops(model).count("ReduceSum") < sums


APART = """<ir_version: 9, opset_import: ["" : 17]>
g (float[6,8,4,5] features, float[1,2,9,6,3,2] grid, float[1,2,1,9,18] weights)
  => (float[1,9,8] y) <
     int64[6] split = {1, 6, 2, 4, 4, 5}, int64[4] atlas = {2, 4, 4, 30},
     int64[4] at = {2, 9, 18, 2}, int64[5] apart = {1, 2, 4, 9, 18},
     int64[3] all = {1, 8, 9}, int64[1] last = {-1}> {
    a = Reshape(features, split)
    b = Transpose<perm = [0, 2, 3, 4, 1, 5]>(a)
    image = Reshape(b, atlas)
    places = Reshape(grid, at)
    s = GridSample(image, places)
    t = Reshape(s, apart)
    m = Mul(t, weights)
    r = ReduceSum<keepdims = 0>(m, last)
    h = Reshape(r, all)
    y = Transpose<perm = [0, 2, 1]>(h)
}"""


def test_images_side_by_side_are_one_level() -> None:
    fused(read(APART))


LEFT: dict[str, tuple[Any, str]] = {
    "nearest": (plain('GridSample<mode = "nearest">'), "mode=nearest"),
    "border": (plain('GridSample<padding_mode = "border">'), "padding_mode=border"),
    "corners": (plain("GridSample<align_corners = 1>"), "align_corners=1"),
    "channels": (plain(weights="float[6,4,9,3]"), "from channel to channel"),
    "spread": (plain(weights="float[2,6,4,9,3]", axes=(4,)), "not multiplied"),
    "summed": (plain(axes=(1, 3)), "over channels or heads too"),
    "unknown": (plain(weights="float[6,1,9,3]").clone(), "run fold-constants first"),
}


JOINED = """<ir_version: 9, opset_import: ["" : 17]>
g (float[1,4,5,7] image, float[1,9,3,2] grid, float[1,4,9,3] other, float[6] weights)
  => (float[1,4,9] y) <int64[1] last = {-1}> {
    s = GridSample(image, grid)
    c = Concat<axis = 3>(s, other)
    m = Mul(c, weights)
    y = ReduceSum<keepdims = 0>(m, last)
}"""
UNSUMMED = """<ir_version: 9, opset_import: ["" : 17]>
g (float[1,4,5,7] image, float[1,9,3,2] grid, float[3] weights) => (float[1,4,9,3] y) {
    s = GridSample(image, grid)
    y = Mul(s, weights)
}"""
READ_TWICE = """g (float[1,4,5,7] image, float[1,9,3,2] grid, float[3] weights)
  => (float[1,4,9] y, float[1,4,9,3] m) <int64[1] last = {-1}> {
    s = GridSample(image, grid)
    m = Mul(s, weights)
    y = ReduceSum<keepdims = 0>(m, last)
}"""
LEFT |= {
    "joined": (read(JOINED), "joined with something else"),
    "unsummed": (read(UNSUMMED), "not summed"),
    "read twice": (read(READ_TWICE), "not summed"),
}


@pytest.mark.parametrize("case", LEFT)
def test_what_is_none_is_left_with_the_reason(case: str) -> None:
    model, reason = LEFT[case]
    if case == "unknown":
        model.graph.inputs[0].shape = ir.Shape(["batch", 4, 5, 7])
    result = apply(FuseOperators(), model)
    assert result.changes == 0
    (note,) = result.notes
    assert note.startswith("left n0: ")
    assert reason in note


def test_a_match_whose_body_differs_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    right = DeformableAttention.body

    def wrong(self: Any, call: Any, inputs: Any, attributes: Any) -> Any:
        result = right(self, call, inputs, attributes)
        return call.add("Mul", [result, call.numbers(1.01, result)])

    monkeypatch.setattr(DeformableAttention, "body", wrong)
    model = inferred(decomposed(Sizes()))
    before = digest(model)
    result = FuseOperators().run(model, NO_MODULES)
    assert result.changes == 0
    assert digest(model) == before
    assert all("differs by 1.0e-02" in note for note in result.notes)
    assert len(result.notes) == len(Sizes().levels)


TWICE = """g (float[1,4,5,7] image, float[1,9,3,2] grid, float[3] weights)
  => (float[1,4,9] y, float[1,4,9] z) <int64[1] last = {-1}> {
    s = GridSample(image, grid)
    m = Mul(s, weights)
    y = ReduceSum<keepdims = 0>(m, last)
    deeper = Neg(image)
    t = GridSample(deeper, grid)
    n = Mul(t, weights)
    z = ReduceSum<keepdims = 0>(n, last)
}"""


def test_pieces_that_are_alike_are_proven_once(monkeypatch: pytest.MonkeyPatch) -> None:
    runs, run = [], fuse_operators.run_piece

    def counted(piece: Any, given: Any) -> Any:
        runs.append(piece)
        return run(piece, given)

    monkeypatch.setattr(fuse_operators, "run_piece", counted)
    assert FuseOperators().run(inferred(read(TWICE)), NO_MODULES).changes == 2
    assert len(runs) == 2


def test_a_proof_is_no_zero_against_a_zero() -> None:
    # With this seed the only position drawn first lies outside of the feature map.
    model = decomposed(Sizes(n=1, q=1, m=1, p=1, d=1, levels=((2, 3),)))
    infer_shapes(model)
    with np.errstate(invalid="raise"):
        FuseOperators().run(model, dataclasses.replace(NO_MODULES, seed=7))
    assert FUSED in ops(model)
