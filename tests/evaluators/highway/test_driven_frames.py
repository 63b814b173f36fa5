import itertools

import numpy as np
import pytest

from me2e_compress.base.errors import FramesError
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.evaluators.highway import driven_frames as room
from me2e_compress.evaluators.highway.driven_frames import driven_frames, fresh_routes
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.session import replay
from me2e_compress.simulator.camera_rig import CameraRig
from me2e_compress.simulator.routes import Route
from tests.support.stand_in import write_model

SIZE = (16, 24)


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> OnnxPolicy:
    path = tmp_path_factory.mktemp("driver") / "m.onnx"
    return OnnxPolicy.open(write_model(path, size=SIZE))


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> OnnxPolicy:
    path = tmp_path_factory.mktemp("other") / "m.onnx"
    return OnnxPolicy.open(write_model(path, seed=1))


@pytest.fixture(scope="module")
def seen(policy: OnnxPolicy, driver: OnnxPolicy) -> list[Frame]:
    """Two scenes and a bit."""
    return list(driven_frames(policy, driver, 10, seed=3, scene_length=4))


def test_scenes_begin_with_their_clock_where_routes_do(seen: list[Frame]) -> None:
    assert [frame.index for frame in seen] == list(range(10))
    assert [frame.index for frame in seen if frame.starts_scene] == [0, 4, 8]
    clock = [float(frame.arrays["timestamp"][0]) for frame in seen]
    assert clock == [0.0, 0.5, 1.0, 1.5, 0.0, 0.5, 1.0, 1.5, 0.0, 0.5]


def test_the_inputs_are_the_models_own(policy: OnnxPolicy, seen: list[Frame]) -> None:
    shapes = {name: array.shape for name, array in seen[0].arrays.items()}
    types = {name: array.dtype for name, array in seen[0].arrays.items()}

    assert shapes == {
        "img": (1, 6, 3, *SIZE),
        "lidar2img": (1, 6, 4, 4),
        "can_bus": (18,),
        "command": (1,),
        "timestamp": (1,),
    }
    assert types.pop("command") == np.int64
    assert set(types.values()) == {np.dtype(np.float32)}
    cameras = CameraRig(*SIZE).lidar2img
    np.testing.assert_array_equal(seen[0].arrays["lidar2img"][0], cameras)
    answers = list(replay(policy.session, seen, ["plan"]))
    assert all(np.isfinite(answer["plan"]).all() for answer in answers)


def test_images_are_normalised_as_the_metadata_says(seen: list[Frame]) -> None:
    mean = np.array([100, 110, 120], np.float32)[:, None, None]
    std = np.array([50, 60, 70], np.float32)[:, None, None]

    grey = np.asarray(seen[5].arrays["img"], np.float32)[0] * std + mean

    assert np.abs(grey - np.rint(grey)).max() < 1e-3
    assert grey.min() >= -1e-3
    assert grey.max() <= 255.001
    assert grey.std() > 10


def test_the_can_bus_counts_since_the_last_frame(seen: list[Frame]) -> None:
    for scene in (seen[0:4], seen[4:8]):
        buses = [np.asarray(frame.arrays["can_bus"], float) for frame in scene]
        assert not buses[0][[0, 1, 2, 17]].any()
        for before, now in itertools.pairwise(buses):
            way = float(np.hypot(now[0], now[1]))
            assert way == pytest.approx((before[7] + now[7]) / 4, abs=0.15)
            turned = np.radians(now[17])
            apart = (now[16] - before[16] - turned + np.pi) % (2 * np.pi) - np.pi
            assert apart == pytest.approx(0.0, abs=1e-4)


def test_a_scene_is_the_same_whatever_was_made_before(
    policy: OnnxPolicy, driver: OnnxPolicy, seen: list[Frame]
) -> None:
    last = seen[8]
    again = driven_frames(
        policy, driver, 10, seed=3, scene_length=4, done=8, first=last.place
    )
    for one, other in zip(again, seen[8:], strict=True):
        assert (one.index, one.starts_scene) == (other.index, other.starts_scene)
        for name, array in one.arrays.items():
            np.testing.assert_array_equal(array, other.arrays[name])


def test_the_types_take_turns_and_another_seed_has_other_routes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(room, "propose", bare)  # no road is made of it
    types = [route.scenario for route in itertools.islice(fresh_routes(5), 88)]
    assert len(set(types[:44])) == 44
    assert types[:44] == types[44:]
    one, two = (itertools.islice(fresh_routes(seed), 3) for seed in (0, 1))
    assert {route.seed for route in one}.isdisjoint(route.seed for route in two)


def bare(scenario: str, seed: int, name: str) -> Route:
    return Route(name, scenario, seed)


def test_no_route_is_one_that_drivers_are_judged_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A route that the set has is passed over."""
    first, second = itertools.islice(fresh_routes(0), 2)
    monkeypatch.setattr(room, "load_routes", lambda: (first,))

    assert next(fresh_routes(0)) == second


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ((0, 0, 4), "0 frames in scenes of 4: both must be at least 1"),
        ((4, 0, 0), "4 frames in scenes of 0: both must be at least 1"),
        ((4, -1, 4), "seed -1: must be 0 or more"),
    ],
)
def test_bad_numbers(
    policy: OnnxPolicy, driver: OnnxPolicy, numbers: tuple[int, int, int], words: str
) -> None:
    count, seed, length = numbers
    with pytest.raises(FramesError, match=words):
        next(driven_frames(policy, driver, count, seed=seed, scene_length=length))
