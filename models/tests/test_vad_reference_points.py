import math
from typing import Literal

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional

from models.bev.attention import deformable_attention
from models.bev.reference_points import (
    cell_positions,
    ego_shift,
    pillars,
    project,
    turn,
)
from models.bev.sampling import sample
from models.vad.config import GRID


def can_bus(dx: float, dy: float, yaw: float, turned_deg: float = 0.0) -> Tensor:
    out = torch.zeros(18)
    out[0], out[1], out[16], out[17] = dx, dy, yaw, turned_deg
    return out


@given(
    dx=st.floats(-20, 20, width=32),
    dy=st.floats(-20, 20, width=32),
    yaw=st.floats(-6, 6, width=32),
)
@settings(max_examples=50, deadline=None)
def test_shift_is_the_one_of_the_original(dx: float, dy: float, yaw: float) -> None:
    length, angle = math.hypot(dx, dy), math.atan2(dy, dx)
    expected = [
        length * math.sin(yaw - angle) / 30,
        length * math.cos(yaw - angle) / 60,
    ]
    got = ego_shift(can_bus(dx, dy, yaw), GRID)[0].tolist()
    assert got == pytest.approx(expected, abs=1e-5)


def test_no_turn_changes_nothing() -> None:
    bev = torch.randn(10000, 1, 256, generator=torch.Generator().manual_seed(0))
    same = turn(bev, can_bus(0, 0, 0), cell_positions(GRID), GRID, "operator")
    assert torch.equal(same[0], bev[:, 0])


def test_quarter_turn_is_about_the_corner() -> None:
    """About cell (100, 100) of a 100 x 100 grid, 90 degrees leave only outside."""
    bev = torch.ones(10000, 1, 256)
    turned = turn(bev, can_bus(0, 0, 0, 90.0), cell_positions(GRID), GRID, "operator")
    assert float(turned.abs().sum()) == 0


def test_half_pillar_projects_to_the_pixel() -> None:
    points = pillars((2, 2), (-1.0, -1.0, 1.0, 1.0, 1.0, 3.0), 1)
    lidar2img = torch.eye(4)[None, None]
    at, visible = project(points, lidar2img, (4, 8))
    assert points.squeeze(-1)[0, 3].tolist() == [0.5, 0.5, 2.0, 1.0]
    assert at[0, 3, 0].tolist() == pytest.approx([0.25 / 8, 0.25 / 4])
    assert visible[0, :, 0].tolist() == [0.0, 0.0, 0.0, 1.0]


@pytest.mark.parametrize("mode", ["bilinear", "nearest"])
@pytest.mark.parametrize("seed", range(3))
def test_gathers_say_the_same_as_grid_sample(
    mode: Literal["bilinear", "nearest"], seed: int
) -> None:
    generator = torch.Generator().manual_seed(seed)
    image = torch.randn(2, 3, 5, 7, generator=generator)
    grid = torch.rand(2, 6, 4, 2, generator=generator) * 3 - 1.5
    gathered = sample(image, grid, "gather", mode)
    operator = functional.grid_sample(image, grid, mode=mode, align_corners=False)
    assert torch.allclose(gathered, operator, atol=1e-5)


def test_deformable_attention_against_a_loop() -> None:
    rng = np.random.default_rng(0)
    value = rng.normal(size=(1, 12, 2, 3)).astype(np.float32)
    cells = rng.integers(0, [4, 3], size=(1, 5, 2, 1, 4, 2))
    weights = rng.random(size=(1, 5, 2, 1, 4)).astype(np.float32)
    centres = ((cells + 0.5) / [4, 3]).astype(np.float32)
    expected = np.zeros((1, 5, 6), np.float32)
    for query, head, point in np.ndindex(5, 2, 4):
        column, row = cells[0, query, head, 0, point]
        part = value[0, row * 4 + column, head] * weights[0, query, head, 0, point]
        expected[0, query, head * 3 : head * 3 + 3] += part
    got = deformable_attention(
        torch.from_numpy(value),
        ((3, 4),),
        torch.from_numpy(centres),
        torch.from_numpy(weights),
        "operator",
    )
    assert np.allclose(got.numpy(), expected, atol=1e-5)


def test_samples_of_two_levels_add_up() -> None:
    hws, starts = ((3, 4), (2, 2)), (0, 12, 16)
    generator = torch.Generator().manual_seed(0)
    value = torch.randn(1, 16, 2, 3, generator=generator)
    locations = torch.rand(1, 5, 2, 2, 4, 2, generator=generator)
    weights = torch.rand(1, 5, 2, 2, 4, generator=generator)
    one_by_one = [
        deformable_attention(
            value[:, starts[level] : starts[level + 1]],
            (hw,),
            locations[:, :, :, level : level + 1],
            weights[:, :, :, level : level + 1],
            "operator",
        )
        for level, hw in enumerate(hws)
    ]
    got = deformable_attention(value, hws, locations, weights, "operator")
    torch.testing.assert_close(got, one_by_one[0] + one_by_one[1])
