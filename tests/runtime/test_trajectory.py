"""Waypoints of any number and spacing, as a model has them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.base.errors import EvaluationError, GraphError
from me2e_compress.runtime.plan_adapter import PlanAdapter, Trajectory

OUT = {"way": np.arange(8, dtype=np.float32).reshape(1, 4, 2)}


def read(adapter: PlanAdapter, way: np.ndarray, **inputs: np.ndarray) -> Trajectory:
    return adapter.trajectory(adapter.plan({"way": way}, inputs))


THIRTY = np.zeros((1, 30, 2))


@pytest.mark.parametrize(
    ("step_s", "first_s", "way", "left", "times_s"),
    [
        (0.5, None, OUT["way"], 4, {0: 0.5, 1: 1.0, 2: 1.5, 3: 2.0}),  # TCP's
        (0.1, None, THIRTY, 30, {2: 0.3, 29: 3.0}),  # whole microseconds
        (0.2, -0.2, OUT["way"], 2, {0: 0.2, 1: 0.4}),  # without now and before
    ],
)
def test_waypoints_have_their_times(
    step_s: float,
    first_s: float | None,
    way: np.ndarray,
    left: int,
    times_s: dict[int, float],
) -> None:
    found = read(PlanAdapter(output="way", step_s=step_s, first_s=first_s), way)

    assert found.points.tolist() == way[0, -left:].tolist()
    assert {at: found.times_s[at] for at in times_s} == times_s


def test_six_alone_need_no_spacing() -> None:
    adapter = PlanAdapter(output="way")

    assert read(adapter, np.zeros((1, 6, 2))).times_s[5] == 3.0
    with pytest.raises(GraphError, match=r"must be \[6, 2\], or step_s must say"):
        read(adapter, OUT["way"])


def test_a_flat_output_is_laid_out() -> None:
    adapter = PlanAdapter(output="way", shape=(6, 2))

    assert adapter.plan({"way": np.arange(12.0)[None]}, {})[5].tolist() == [10.0, 11.0]
    with pytest.raises(GraphError, match=r"\[1, 8\], which cannot be laid out"):
        adapter.plan({"way": np.zeros((1, 8))}, {})


def test_a_heading_beside_the_coordinates_is_left_out() -> None:
    way = np.arange(18.0).reshape(1, 6, 3)

    found = PlanAdapter(output="way", columns=(1, 2)).plan({"way": way}, {})

    assert found[0].tolist() == [1.0, 2.0]
    with pytest.raises(GraphError, match="there is no column 3"):
        PlanAdapter(output="way", columns=(0, 3)).plan({"way": way}, {})


MODES = np.arange(3.0)[None, :, None, None] * np.ones((1, 3, 6, 2))


@pytest.mark.parametrize(
    ("adapter", "inputs", "mode"),
    [
        (PlanAdapter(output="way", default_mode=2), {}, 2),
        (PlanAdapter(output="way", command_input="go"), {"go": np.array([1])}, 1),
        (
            PlanAdapter(output="way", command_input="go"),
            {"go": np.array([[0.0, 0.0, 1.0]])},
            2,
        ),
        (
            PlanAdapter(output="way", command_input="go", command_modes=(1, 0, 2, 2)),
            {"go": np.array([3])},
            2,
        ),
    ],
)
def test_what_picks_the_mode(
    adapter: PlanAdapter, inputs: dict[str, np.ndarray], mode: int
) -> None:
    assert adapter.plan({"way": MODES}, inputs)[0, 0] == mode


@pytest.mark.parametrize("shape", [(3,), (1, 3), (1, 1, 3)])
def test_the_largest_score_picks_the_mode(shape: tuple[int, ...]) -> None:
    votes = np.array([0.1, 0.2, 0.7]).reshape(shape)
    adapter = PlanAdapter(output="way", scores="votes")
    assert adapter.plan({"way": MODES, "votes": votes}, {})[0, 0] == 2


@pytest.mark.parametrize(
    ("adapter", "message"),
    [
        (PlanAdapter(output="way"), "way has 3 modes and nothing picks one"),
        (PlanAdapter(output="way", default_mode=3), "mode 3 of way: it has 3 modes"),
        (
            PlanAdapter(output="way", command_input="go", command_modes=(0,)),
            "command_modes names no mode of command 5",
        ),
        (PlanAdapter(output="way", scores="few"), "few has 2 scores, and way 3 modes"),
    ],
)
def test_a_mode_that_nothing_picks(adapter: PlanAdapter, message: str) -> None:
    with pytest.raises(GraphError, match=message):
        adapter.plan({"way": MODES, "few": np.ones((1, 2))}, {"go": np.array([5])})


@pytest.mark.parametrize(
    ("points", "times", "message"),
    [
        (np.zeros((2, 3)), np.ones(2), r"shape \[2, 3\], they must be \[n, 2\]"),
        (np.zeros((0, 2)), np.ones(0), r"shape \[0, 2\]"),
        (np.zeros((2, 2)), np.ones(3), r"2 waypoints and times of shape \[3\]"),
        (np.zeros((2, 2)), np.array([0.5, 0.5]), "must increase from above 0"),
        (np.zeros((1, 2)), np.zeros(1), "must increase from above 0"),
    ],
)
def test_what_is_no_trajectory(
    points: np.ndarray, times: np.ndarray, message: str
) -> None:
    with pytest.raises(EvaluationError, match=message):
        Trajectory(points, times)


def test_none_lies_ahead() -> None:
    with pytest.raises(EvaluationError, match="no waypoint lies after"):
        Trajectory.ahead(np.zeros((2, 2)), np.array([-0.5, 0.0]))


@given(st.lists(st.floats(-50, 50), min_size=2, max_size=12), st.floats(0.05, 1.0))
def test_between_waypoints_it_goes_straight(values: list[float], step: float) -> None:
    points = np.array(values[: len(values) // 2 * 2]).reshape(-1, 2)
    times = step * (1 + np.arange(len(points)))
    way = Trajectory(points, times)

    assert np.allclose(way.at(times), points)
    assert np.allclose(way.at(times[:1] / 2), points[:1] / 2)
    last = points[-1] - (points[-2] if len(points) > 1 else np.zeros(2))
    assert np.allclose(way.at(times[-1:] + step), points[-1] + last)
