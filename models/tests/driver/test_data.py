"""Episodes in memory: sequences, moves, and files that are no episodes."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.evaluators.highway.observe import can_bus_of
from me2e_compress.simulator.scene import Ego
from models.driver.data import Episodes, Sequences
from models.driver.errors import TrainingError
from models.tests.driver.made import SIZE, arrays_of, write
from tests.support.profiles import scaled

LENGTHS = (3, 9, 1, 14)


@pytest.fixture(scope="module")
def episodes(tmp_path_factory: pytest.TempPathFactory) -> Episodes:
    folder = tmp_path_factory.mktemp("episodes")
    files = [write(folder / f"{i}.npz", arrays_of(n, i)) for i, n in enumerate(LENGTHS)]
    return Episodes(files, SIZE)


@given(
    seed=st.integers(0, 2**32 - 1),
    length=st.integers(1, 5),
    strides=st.lists(st.integers(1, 4), min_size=1, max_size=3).map(tuple),
)
def test_a_sequence_stays_in_its_episode_and_in_order(
    episodes: Episodes, seed: int, length: int, strides: tuple[int, ...]
) -> None:
    rng = np.random.default_rng(seed)
    picked = episodes.draw(rng, 50, Sequences(length, strides))
    assert picked.shape == (50, length)
    assert (episodes.first[picked] == episodes.first[picked[:, :1]]).all()
    assert (np.diff(picked, axis=1) >= 0).all()


def test_every_sample_can_be_the_last_of_a_sequence(episodes: Episodes) -> None:
    picked = episodes.draw(np.random.default_rng(0), 3000, Sequences(1))
    assert set(picked[:, 0].tolist()) == set(range(sum(LENGTHS)))


def test_the_same_draws_from_the_same_seed(episodes: Episodes) -> None:
    draws = [
        episodes.draw(np.random.default_rng(4), 20, Sequences()).tobytes()
        for _ in range(2)
    ]
    assert draws[0] == draws[1]


def ego(x: float, y: float, heading: float) -> Ego:
    return Ego(x, y, heading, 7.0, 0.5, -0.3, 0.1, 0.0, 5.0, 2.0)


@settings(max_examples=scaled(20))
@given(seed=st.integers(0, 2**32 - 1), stride=st.integers(1, 3))
def test_the_can_bus_is_what_the_policy_would_be_shown(
    tmp_path_factory: pytest.TempPathFactory, seed: int, stride: int
) -> None:
    rng = np.random.default_rng(seed)
    poses = rng.uniform([-500, -500, -9], [500, 500, 9], (8, 3))
    egos = [ego(*pose) for pose in poses]
    arrays = arrays_of(8, size=(16, 24))
    arrays["pose"] = poses
    arrays["can_bus"] = np.stack([can_bus_of(each, None) for each in egos])
    file = write(tmp_path_factory.mktemp("bus") / "a.npz", arrays)
    picked = np.array([[0, stride, 2 * stride]])
    found = Episodes([file], (16, 24)).batch(picked)["can_bus"][0]
    last = None
    for row, index in zip(found, picked[0], strict=True):
        wanted = can_bus_of(egos[index], last)
        turn = (row[17] - wanted[17] + 180) % 360 - 180  # half a turn has two names
        assert turn == pytest.approx(0, abs=1e-3)
        assert np.delete(row, 17) == pytest.approx(np.delete(wanted, 17), abs=1e-4)
        last = egos[index]


def test_moves_are_counted_from_where_the_ego_is_beside_the_route(
    tmp_path: Path,
) -> None:
    arrays = arrays_of(2)
    arrays["lateral_m"][:] = 0.75
    arrays["path"][..., 1] = -0.75  # the route is to the right
    moves = Episodes([write(tmp_path / "a.npz", arrays)], SIZE).moves
    assert moves[0, :, 0] == pytest.approx(2.5 * np.arange(1, 7))
    assert moves[0, :, 1] == pytest.approx(np.zeros(6), abs=1e-6)


def test_who_goes_on_as_now_departs_nowhere(episodes: Episodes) -> None:
    assert episodes.departures() == pytest.approx(0, abs=1e-5)


def test_decisive_samples_are_drawn_more(tmp_path: Path) -> None:
    arrays = arrays_of(4)
    arrays["signals"][:, 0, 0] = -1
    arrays["plan_alone"][1, :, 0] += 1.0
    arrays["plan_alone"][2, :, 0] += 3.0
    arrays["command"][3] = 0
    weights = Episodes([write(tmp_path / "a.npz", arrays)], SIZE).weights
    assert (weights / weights[0]).tolist() == pytest.approx([1, 3, 4, 2])


def test_a_file_named_twice_is_read_once_and_drawn_twice_as_often(
    tmp_path: Path,
) -> None:
    once, twice = (write(tmp_path / f"{i}.npz", arrays_of(4, 1)) for i in range(2))
    found = Episodes([once, twice, twice], SIZE)
    assert len(found) == 8
    np.testing.assert_allclose(found.weights[4:], 2 * found.weights[:4])


def test_a_line_nearby_is_drawn_more(tmp_path: Path) -> None:
    arrays = arrays_of(3)
    arrays["signals"][:, 0, 6] = (15.0, 26.0, math.nan)
    weights = Episodes([write(tmp_path / "a.npz", arrays)], SIZE).weights
    assert (weights / weights[1]).tolist() == pytest.approx([2, 1, 1])


def test_pictures_belong_to_their_samples(episodes: Episodes) -> None:
    alone = Episodes.images(episodes, np.array([5]))[0]
    among = episodes.images(np.array([0, 5, 20]))[1]
    assert (alone == among).all()


def test_no_episode_is_an_error() -> None:
    with pytest.raises(TrainingError, match="there are no episodes to learn from"):
        Episodes([], SIZE)


def test_cameras_of_another_layout_name_the_file_and_both_sizes(
    tmp_path: Path,
) -> None:
    file = write(tmp_path / "small.npz", arrays_of(2, size=(48, 80)))
    words = r"small\.npz: its cameras have 48 x 80 pixels, the model sees 96 x 160"
    with pytest.raises(TrainingError, match=words):
        Episodes([file], SIZE)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"plan": np.zeros((2, 5, 2))}, r"plan is \[2, 5, 2\], with 2 pictures it"),
        ({"pose": np.zeros((1, 3))}, r"pose is \[1, 3\], with 2 pictures it must be"),
        ({"jpeg": np.zeros(99, np.uint8)}, "is not a JPEG"),
        ({"jpeg_offsets": np.array([0])}, "with 0 pictures"),
        ({"plan": None}, "it has no plan"),
        ({"jpeg": None}, "it has no jpeg"),
    ],
)
def test_arrays_that_are_no_episode(
    tmp_path: Path, change: dict[str, Any], words: str
) -> None:
    arrays = {**arrays_of(2), **change}
    there = {name: each for name, each in arrays.items() if each is not None}
    file = write(tmp_path / "odd.npz", there)
    with pytest.raises(TrainingError, match=rf"odd\.npz: not an episode: .*{words}"):
        Episodes([file], SIZE)


@pytest.mark.parametrize(
    "harm",
    [
        lambda whole: b"",
        lambda whole: b"not an archive",
        lambda whole: whole[: len(whole) // 2],
        lambda whole: whole[:4000] + bytes(64) + whole[4064:],
        lambda whole: b"\x93NUMPY" + whole,
    ],
)
def test_a_file_that_is_no_episode_is_named(
    tmp_path: Path, harm: Callable[[bytes], bytes]
) -> None:
    file = write(tmp_path / "a.npz", arrays_of(2))
    file.write_bytes(harm(file.read_bytes()))
    with pytest.raises(TrainingError, match=r"a\.npz: not an episode: ") as caught:
        Episodes([file], SIZE)
    assert "\n" not in str(caught.value)


def test_a_single_array_or_no_file_is_no_episode(tmp_path: Path) -> None:
    with (tmp_path / "array.npz").open("wb") as file:
        np.save(file, np.zeros(3))
    for name in ("array.npz", "gone.npz"):
        with pytest.raises(TrainingError, match=rf"{name}: not an episode: "):
            Episodes([tmp_path / name], SIZE)
