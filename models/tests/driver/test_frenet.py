"""Plans in the frame of the route."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from models.driver.frenet import anchors_of, project
from models.driver.network.bev_grid import route_points
from models.driver.network.planner import along

POINTS = 25


def there_and_back(
    arc: np.ndarray, offset: np.ndarray, headings: np.ndarray
) -> np.ndarray[tuple[int, ...], np.dtype[np.floating]]:
    """Places of moves [1, K, T] beside a route, as moves again: [K, T, 2]."""
    turns = torch.from_numpy(headings)[None]
    path = route_points(torch.zeros(1, dtype=turns.dtype), turns)
    places, _ = along(torch.from_numpy(arc), torch.from_numpy(offset), path, turns)
    found = project(places[0].numpy(), path.repeat(arc.shape[1], 1, 1).numpy())
    return np.asarray(found)


@given(seed=st.integers(0, 2**32 - 1))
def test_on_a_straight_route_project_is_the_inverse_of_along(seed: int) -> None:
    rng = np.random.default_rng(seed)
    arc, offset = rng.uniform(0.1, 47.9, (1, 3, 6)), rng.uniform(-6, 6, (1, 3, 6))
    back = there_and_back(arc, offset, np.full(POINTS, rng.uniform(-3, 3)))
    assert back[..., 0] == pytest.approx(arc[0], abs=1e-4)
    assert back[..., 1] == pytest.approx(offset[0], abs=1e-4)


@given(seed=st.integers(0, 2**32 - 1))
def test_in_a_bend_it_nearly_is(seed: int) -> None:
    rng = np.random.default_rng(seed)
    arc, offset = rng.uniform(2, 46, (1, 3, 6)), rng.uniform(-2, 2, (1, 3, 6))
    radius_m = rng.uniform(15, 100) * rng.choice([-1, 1])
    back = there_and_back(arc, offset, 2.0 / radius_m * np.arange(POINTS))
    assert back[..., 0] == pytest.approx(arc[0], abs=0.15)
    assert back[..., 1] == pytest.approx(offset[0], abs=0.05)


def test_a_point_behind_the_route_is_at_its_beginning() -> None:
    path = np.stack([2.0 * np.arange(5), np.zeros(5)], -1)[None]
    assert project(np.array([[[-3.0, 0.0]]]), path)[0, 0].tolist() == [0.0, 0.0]


def test_left_is_positive() -> None:
    path = np.stack([np.zeros(5), 2.0 * np.arange(5)], -1)[None]  # goes to the left
    found = project(np.array([[[-1.5, 4.0], [1.5, 5.0]]]), path)[0]
    assert found.tolist() == [[4.0, 1.5], [5.0, -1.5]]


def test_rare_plans_keep_an_anchor() -> None:
    rng = np.random.default_rng(0)
    usual = rng.normal(0, 0.5, (2000, 6, 2))
    swerve = rng.normal([0.0, 4.0], 0.05, (3, 6, 2))
    anchors = anchors_of(np.concatenate([usual, swerve]), 8)
    assert np.abs(anchors - [0.0, 4.0]).max((1, 2)).min() < 0.3


def test_anchors_are_centres_of_what_is_nearest_to_them() -> None:
    plans = np.repeat(np.array([[0.0, 0.0], [5.0, 1.0], [9.0, -2.0]]), 4, 0)
    rows = np.repeat(plans[:, None], 6, 1) + np.tile([-0.1, 0.1], 6)[:, None, None]
    anchors = anchors_of(rows, 3)
    assert sorted(anchors[:, 0].round(5).tolist()) == [[0, 0], [5, 1], [9, -2]]


def test_the_same_plans_give_the_same_anchors() -> None:
    plans = np.random.default_rng(1).normal(size=(100, 6, 2))
    assert anchors_of(plans, 9).tobytes() == anchors_of(plans.copy(), 9).tobytes()
