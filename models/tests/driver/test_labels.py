"""Labels as tensors."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.simulator.scene import PixelClass
from models.driver.label_tensors import labels_of, raster_of, signals_of
from models.driver.network.bev_grid import cell_centres
from models.driver.network.config import BevArea
from models.tests.driver.made import Arrays, arrays_of

AREA = BevArea()
LIGHT, STOP, GIVE_WAY = 0, 1, 2


def batch(samples: int = 2) -> Arrays:
    """What `Episodes.batch` gives, flattened."""
    arrays = arrays_of(samples, size=(16, 24))
    return {**arrays, "moves": arrays["plan"], "shift_m": np.zeros(samples)}


@pytest.mark.parametrize(
    ("kind", "channels"),
    [
        (PixelClass.TERRAIN, []),
        (PixelClass.SHOULDER, [1]),
        (PixelClass.DRIVABLE, [0]),
        (PixelClass.LANE_MARKING, [0, 2]),
        (PixelClass.STOP_LINE, [0, 3]),
        (PixelClass.CROSSWALK, [0]),
    ],
)
def test_the_raster_of_a_class(kind: PixelClass, channels: list[int]) -> None:
    ground = torch.full((1, 4, 3), PixelClass.TERRAIN, dtype=torch.uint8)
    ground[0, 1, 2] = kind
    assert raster_of(ground)[0, :, 1, 2].nonzero()[:, 0].tolist() == channels


def rows(*signals: tuple[float, float, float]) -> torch.Tensor:
    """Kind, state and metres to the line of signals, as recorded: [1, S, 8]."""
    recorded = torch.zeros(1, len(signals), 8)
    for row, (kind, state, gap) in zip(recorded[0], signals, strict=True):
        row[0], row[1], row[6] = kind, state, gap
    return recorded


def test_the_nearest_signal_of_each_kind_counts() -> None:
    found = signals_of(rows((LIGHT, 2, 30), (STOP, -1, 12), (LIGHT, 0, 8)))[0]
    assert found.tolist() == [[1, 8, 0], [1, 12, -1], [0, 0, -1]]


@pytest.mark.parametrize("gap", [-4.0, 41.0, math.nan])
def test_a_line_out_of_sight_is_not_there(gap: float) -> None:
    assert signals_of(rows((GIVE_WAY, -1, gap)))[0, GIVE_WAY].tolist() == [0, 0, -1]


def test_no_signal_is_not_there() -> None:
    assert signals_of(rows((-1, -1, 10)))[0, :, 0].tolist() == [0, 0, 0]


def test_occupancy_is_unpacked_onto_its_grid() -> None:
    arrays, taken = batch(1), np.zeros((6, 64, 48), bool)
    taken[2, 27, 19] = True
    arrays["occupancy"] = np.packbits(taken.reshape(1, 6, -1), axis=-1)
    found = labels_of(arrays, AREA).occupancy
    assert found.nonzero().tolist() == [[0, 2, 27, 19]]


def test_steps_after_the_end_of_the_route_are_unknown() -> None:
    arrays = batch(2)
    arrays["known_steps"] = np.array([0, 4])
    known = labels_of(arrays, AREA).occupancy_known
    assert known.int().tolist() == [[0] * 6, [1, 1, 1, 1, 0, 0]]


@given(x=st.floats(-15.9, 47.9), y=st.floats(-23.9, 23.9))
def test_an_agent_is_in_the_cell_whose_centre_is_nearest(x: float, y: float) -> None:
    arrays = batch(1)
    arrays["agents"][0, 0, 1:3] = x, y
    cell = int(labels_of(arrays, AREA).cells[0, 0])
    centre = cell_centres(AREA)[cell]
    assert (centre - torch.tensor([x, y])).abs().max() <= AREA.cell_m / 2 + 1e-4


def test_travel_is_from_where_the_agent_is_now() -> None:
    targets = labels_of(batch(), AREA)
    assert targets.travel[0, 0, :, 0].tolist() == pytest.approx(
        [2.5, 5, 7.5, 10, 12.5, 15]
    )
    assert targets.travel[0, 1, 5].tolist() == pytest.approx([0, -6])


def test_travel_that_nobody_saw_and_places_without_agents_are_unknown() -> None:
    arrays = batch()
    arrays["futures"][0, 0, 3:] = np.nan
    targets = labels_of(arrays, AREA)
    assert targets.travel_known[0, 0].tolist() == [True] * 3 + [False] * 3
    assert targets.travel[0, 0, 3:].abs().max() == 0
    assert targets.there[0].tolist() == [True, True] + [False] * 22
    assert not targets.travel_known[0, 2:].any()


def test_more_free_road_than_three_lanes_is_as_good() -> None:
    arrays = batch()
    arrays["path_attributes"][0, 0] = (3.0, 30.0, 14.0, 20.0)
    found = labels_of(arrays, AREA).attributes[0, 0]
    assert found.tolist() == [3, 12, 12, 20]


def test_recorded_arrays_stay_as_they_are() -> None:
    arrays = batch()
    before = {name: array.tobytes() for name, array in arrays.items()}
    labels_of(arrays, AREA).attributes.zero_()
    assert {name: array.tobytes() for name, array in arrays.items()} == before
