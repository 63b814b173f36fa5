"""What looks like deformable attention and is none is left, with the reason."""

from typing import Any

import onnx_ir as ir
import pytest

from me2e_compress.passes.fuse_operators import FuseOperators
from tests.passes.decomposed import plain
from tests.passes.small import apply, read

LEFT: dict[str, tuple[Any, str]] = {
    "nearest": (plain('GridSample<mode = "nearest">'), "mode=nearest"),
    "border": (plain('GridSample<padding_mode = "border">'), "padding_mode=border"),
    "corners": (plain("GridSample<align_corners = 1>"), "align_corners=1"),
    "channels": (plain(weights="float[6,4,9,3]"), "from channel to channel"),
    "spread": (plain(weights="float[2,6,4,9,3]", axes=(4,)), "not multiplied"),
    "summed": (plain(axes=(1, 3)), "over channels or heads too"),
    "unknown": (
        plain(weights="float[6,1,9,3]").clone(),
        "run fold-constants first",
    ),
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
READ_TWICE = """<ir_version: 9, opset_import: ["" : 17]>
g (float[1,4,5,7] image, float[1,9,3,2] grid, float[3] weights)
  => (float[1,4,9] y, float[1,4,9,3] m) <int64[1] last = {-1}> {
    s = GridSample(image, grid)
    m = Mul(s, weights)
    y = ReduceSum<keepdims = 0>(m, last)
}"""


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (JOINED, "joined with something else"),
        (UNSUMMED, "not summed"),
        (READ_TWICE, "not summed"),
    ],
)
def test_a_part_of_one_is_left(text: str, reason: str) -> None:
    result = apply(FuseOperators(), read(text))
    assert result.changes == 0
    assert reason in result.notes[0]
