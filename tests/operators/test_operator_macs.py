"""Multiply-accumulates of fused operators, counted by hand."""

from typing import Any

import pytest

from me2e_compress.graph import infer_shapes, macs, static_shape
from me2e_compress.graph.shapes import Dims
from me2e_compress.operators import OPERATORS
from tests.support.nets import parsed

Shapes = list[Dims | None]

IMAGE, VOLUME = (2, 3, 8, 9), (2, 3, 6, 8, 9)
GRID, CUBE = (2, 4, 5, 2), (2, 4, 5, 6, 3)


@pytest.mark.parametrize(
    ("name", "shapes", "attributes", "expected"),
    [
        ("inverse", [(6, 4, 4)], {}, 6 * 4**3),
        ("inverse", [(2, 3, 5, 5)], {}, 2 * 3 * 5**3),
        ("grid-sampler-2d", [IMAGE, GRID], {"interpolation_mode": 0}, 4 * 2 * 3 * 20),
        ("grid-sampler-2d", [IMAGE, GRID], {"interpolation_mode": 1}, 0),
        ("grid-sampler-2d", [IMAGE, GRID], {"interpolation_mode": 2}, 16 * 2 * 3 * 20),
        ("grid-sampler-3d", [VOLUME, CUBE], {"interpolation_mode": 0}, 8 * 2 * 3 * 120),
        ("grid-sampler-3d", [VOLUME, CUBE], {"interpolation_mode": 1}, 0),
        ("rotate", [(3, 8, 9), (1,), (2,)], {"interpolation": 0}, 4 * 3 * 8 * 9),
        ("rotate", [(3, 8, 9), (1,), (2,)], {"interpolation": 1}, 0),
        ("multi-head-attention", [(2, 5, 8), (2, 7, 8), (2, 7, 8)], {}, 2 * 2 * 35 * 8),
        (
            "deformable-attention",
            [(1, 30, 8, 32), (1, 2), (1,), (1, 100, 8, 1, 4, 2), (1, 100, 8, 1, 4)],
            {},
            4 * 100 * 8 * 4 * 32,
        ),
        (
            "bev-pool",
            [(2, 3, 2, 2), (2, 2, 2, 4), (11,), (11,), (11,), (5,), (5,)],
            {"out_height": 3, "out_width": 4},
            11 * 4,
        ),
        (
            "deformable-aggregation",
            [(1, 60, 6), (2, 2, 2), (2, 2), (1, 9, 5, 2, 2), (1, 9, 5, 2, 2, 3)],
            {},
            4 * (9 * 5 * 2 * 2) * 6,
        ),
        ("select-and-pad", [(2, 5, 3), (2, 5), (3,)], {"P": 4}, 0),
    ],
)
def test_macs_by_hand(
    name: str, shapes: Shapes, attributes: dict[str, Any], expected: int
) -> None:
    assert OPERATORS.build(name, {}).macs(shapes, attributes) == expected


@pytest.mark.parametrize(
    ("name", "shapes"),
    [
        ("inverse", [(None, 4, 4)]),
        ("inverse", [None]),
        ("grid-sampler-2d", [(2, None, 8, 9), GRID]),
        ("grid-sampler-2d", [IMAGE, (2, None, 5, 2)]),
        ("grid-sampler-2d", [None, GRID]),
        ("rotate", [(3, None, 9), (1,), (2,)]),
        ("multi-head-attention", [(2, 5, 8), (2, None, 8), (2, None, 8)]),
        ("multi-head-attention", [(None, 5, 8), (None, 7, 8), (None, 7, 8)]),
    ],
)
def test_open_shapes_have_none(name: str, shapes: Shapes) -> None:
    attributes = {"interpolation_mode": 0, "interpolation": 0}
    assert OPERATORS.build(name, {}).macs(shapes, attributes) is None


ROTATED = """
g (float[3,8,9] x, float[1] a, float[2] c) => (float[L,M,N] y)
    { z = RotateTRT<ATTRIBUTES>(x, a, c) y = Relu(z) }
"""


@pytest.mark.parametrize(
    ("attributes", "count", "shape"),
    [
        ("interpolation = 0", 4 * 3 * 8 * 9, (3, 8, 9)),
        ("interpolation = 0, border = 2", None, None),
        ("interpolation = 7", None, None),
    ],
    ids=["known", "an attribute more", "a value that it does not have"],
)
def test_what_its_dialect_refuses_nobody_knows(
    attributes: str, count: int | None, shape: tuple[int, ...] | None
) -> None:
    model = parsed(ROTATED.replace("ATTRIBUTES", attributes))
    infer_shapes(model)
    node = model.graph[0]

    assert macs(node) == count
    assert static_shape(node.outputs[0]) == shape
