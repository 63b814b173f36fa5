"""Boxes in the plane, by hand and against small steps of time."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.evaluators.highway.conflict_recorder import (
    contact_times,
    corners,
    gaps,
    overlaps,
)

CAR = np.array([0.0, 0.0, 0.0, 4.0, 2.0])


def box(x: float, y: float, heading: float = 0.0) -> np.ndarray:
    return np.array([x, y, heading, 4.0, 2.0])


places = st.floats(-12.0, 12.0)
boxes = st.builds(box, places, places, st.floats(-math.pi, math.pi))
speeds = st.tuples(st.floats(-9.0, 9.0), st.floats(-9.0, 9.0)).map(np.array)


@pytest.mark.parametrize(
    ("other", "metres"),
    [
        (box(10.0, 0.0), 6.0),
        (box(0.0, 5.0), 3.0),
        (box(7.0, 6.0), 5.0),
        (box(3.0, 1.0), 0.0),
        (box(0.0, 0.0), 0.0),
        (box(10.0, 0.0, math.pi / 2), 7.0),
        (box(5.0 + 3.0 / math.sqrt(2.0), 0.0, math.pi / 4), 3.0),
    ],
)
def test_the_gap_between_two_outlines(other: np.ndarray, metres: float) -> None:
    assert float(gaps(CAR, other)) == pytest.approx(metres)


def test_corners_of_a_turned_box() -> None:
    turned = corners(box(1.0, 2.0, math.pi / 2))

    assert turned.tolist() == [
        pytest.approx(point) for point in ([0, 4], [2, 4], [2, 0], [0, 0])
    ]


@pytest.mark.parametrize(
    ("other", "velocity", "seconds"),
    [
        (box(24.0, 0.0), (-10.0, 0.0), 2.0),
        (box(24.0, 0.0), (10.0, 0.0), math.inf),
        (box(24.0, 3.0), (-10.0, 0.0), math.inf),
        (box(24.0, 3.0), (-10.0, -0.4), 2.5),
        (box(3.0, 0.0), (0.0, 0.0), 0.0),
        (box(9.0, 0.0), (0.0, 0.0), math.inf),
    ],
)
def test_the_time_until_two_boxes_touch(
    other: np.ndarray, velocity: tuple[float, float], seconds: float
) -> None:
    assert float(contact_times(CAR, other, np.array(velocity))) == seconds


@given(boxes, boxes)
def test_a_gap_is_the_same_from_both_sides(one: np.ndarray, other: np.ndarray) -> None:
    there, back = float(gaps(one, other)), float(gaps(other, one))

    assert there == pytest.approx(back, abs=1e-9)
    assert (there == 0.0) == bool(overlaps(one, other))


@given(boxes, boxes, speeds)
def test_boxes_first_touch_at_the_time_of_contact(
    one: np.ndarray, other: np.ndarray, velocity: np.ndarray
) -> None:
    seconds = float(contact_times(one, other, velocity))
    times = np.linspace(0.0, 5.0, 101)
    moved = np.repeat(other[None], len(times), axis=0)
    moved[:, :2] += times[:, None] * velocity
    touching = gaps(one, moved) < 1e-9

    assert not touching[times < seconds - 1e-6].any()
    if seconds <= 5.0:
        arrived = other.copy()
        arrived[:2] += seconds * velocity
        assert float(gaps(one, arrived)) < 1e-6
