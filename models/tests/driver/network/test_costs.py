"""Costs of candidate plans against plain float64 arithmetic."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from models.driver.network.bev_grid import cell_centres, grid_of, route_points
from models.driver.network.config import BevArea
from models.driver.network.costs import (
    DISCS_M,
    NEAR_M,
    RADIUS_M,
    SOFT_M,
    agent_costs,
    between,
    beyond_lines,
    discs_of,
    ground,
    occupied,
)
from models.driver.network.planner import along

FINE = BevArea(cell_m=1.0, rows=64, columns=48)


def test_points_of_a_straight_route_are_two_metres_apart_ahead() -> None:
    points = route_points(torch.tensor([0.5]), torch.zeros(1, 5))
    wanted = [(0, -0.5), (2, -0.5), (4, -0.5), (6, -0.5), (8, -0.5)]
    assert points[0].numpy() == pytest.approx(np.array(wanted))


def test_a_circle_of_headings_is_a_circle_of_points() -> None:
    radius = 20.0
    turn = torch.arange(16) * (2.0 / radius)
    points = route_points(torch.zeros(1), turn[None])[0].double().numpy()
    away = np.hypot(points[:, 0], points[:, 1] - radius)
    assert away == pytest.approx(np.full(16, radius), abs=0.02)


def test_places_beside_a_route_interpolate_its_points() -> None:
    path = route_points(torch.zeros(1), torch.full((1, 9), math.pi / 2))
    places, headings = along(
        torch.tensor([[[3.0, 7.5]]]),
        torch.tensor([[[1.0, -2.0]]]),
        path,
        torch.full((1, 9), math.pi / 2),
    )
    assert places[0, 0].numpy() == pytest.approx(
        np.array([[-1, 3], [2, 7.5]]), abs=1e-5
    )
    assert headings[0, 0].numpy() == pytest.approx(np.full(2, math.pi / 2))


def test_cells_and_grid_agree() -> None:
    area = BevArea()
    grid = grid_of(cell_centres(area), area).unflatten(0, (area.rows, area.columns))
    columns = (2 * torch.arange(area.columns) + 1) / area.columns - 1
    rows = (2 * torch.arange(area.rows) + 1) / area.rows - 1
    assert torch.allclose(grid[..., 0], columns.expand(area.rows, -1), atol=1e-6)
    assert torch.allclose(
        grid[..., 1], rows[:, None].expand(-1, area.columns), atol=1e-6
    )


def test_between_starts_from_the_ego() -> None:
    steps = torch.tensor([[[2.0], [6.0]]])
    assert between(steps)[0, :, 0].tolist() == [1.0, 2.0, 4.0, 6.0]


@settings(deadline=None)  # the machine may be busy
@given(seed=st.integers(0, 2**32 - 1))
def test_agent_costs_match_float64(seed: int) -> None:
    rng = np.random.default_rng(seed)
    discs = rng.normal(0, 8, (1, 2, 3, len(DISCS_M), 2))
    angle = rng.uniform(-math.pi, math.pi, 4)
    boxes = np.column_stack(
        [
            rng.normal(0, 8, (4, 2)),
            rng.uniform(0.5, 8, (4, 2)),
            np.cos(angle),
            np.sin(angle),
            rng.normal(0, 5, (4, 2)),
        ]
    )
    score, travel = rng.random(4), rng.normal(0, 4, (4, 2, 3, 2))
    modes = rng.dirichlet((1, 1), 4)
    overlap, near = agent_costs(
        torch.from_numpy(discs).float(),
        torch.from_numpy(boxes[None]).float(),
        torch.from_numpy(score[None]).float(),
        torch.from_numpy(travel[None]).float(),
        torch.from_numpy(modes[None]).float(),
    )
    wanted = np.zeros((2, 2, 3))
    for k, t, a in np.ndindex(2, 3, 4):
        sums = np.zeros(2)
        for m in range(2):
            place = boxes[a, :2] + travel[a, m, t]
            away = discs[0, k, t] - place
            turn = np.array([[boxes[a, 4], -boxes[a, 5]], [boxes[a, 5], boxes[a, 4]]])
            out = np.maximum(np.abs(away @ turn) - boxes[a, 2:4] / 2, 0)
            gap = np.sqrt((out**2).sum(-1) + 1e-4).min()
            share = score[a] * modes[a, m]
            sums += share * np.array(
                [
                    1 / (1 + math.exp(-(RADIUS_M - gap) / SOFT_M)),
                    math.exp(-gap / NEAR_M),
                ]
            )
        wanted[:, k, t] = np.maximum(wanted[:, k, t], sums)
    assert overlap[0].numpy() == pytest.approx(wanted[0], abs=2e-4)
    assert near[0].numpy() == pytest.approx(wanted[1], abs=2e-4)


def test_the_axis_of_the_ego_carries_its_discs() -> None:
    places = torch.tensor([[[[10.0, 2.0]]]])
    discs = discs_of(places, torch.full((1, 1, 1), math.pi / 2))[0, 0, 0]
    assert discs.numpy() == pytest.approx(np.array([[10, 0.5], [10, 2], [10, 3.5]]))


def test_occupied_ground_is_found_at_its_own_step() -> None:
    taken = torch.zeros(1, 2, FINE.rows, FINE.columns)
    # the cell of x 20 to 21, y 4 to 5: rows from the front, columns from the left
    taken[0, 1, 27, 19] = 1.0
    place = torch.tensor([[[[20.5, 4.5], [20.5, 4.5]]]])
    found = occupied(discs_of(place, torch.zeros(1, 1, 2)), taken, FINE)
    assert found[0, 0].tolist() == pytest.approx([0.0, 1.0])


def test_ground_is_the_mean_under_the_discs() -> None:
    raster = torch.zeros(1, 2, FINE.rows, FINE.columns)
    raster[0, 0, :24] = 1.0  # all that is more than 24 m ahead
    place = torch.tensor([[[[25.0, 0.0]]]])
    found = ground(discs_of(place, torch.zeros(1, 1, 1)), raster, FINE)
    assert found[0, 0, 0].tolist() == pytest.approx([2 / 3, 0.0], abs=1e-5)


def test_a_line_is_crossed_by_the_bumper() -> None:
    past = beyond_lines(torch.tensor([[[0.0, 7.5, 20.0]]]), torch.tensor([[10.0]]))
    assert past[0, 0, :, 0].tolist() == pytest.approx([0.0006, 0.5, 1.0], abs=1e-3)
