"""A whole episode, against an independent drive of the same route."""

import zlib
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from me2e_compress.driving.contract import Observation, Plan
from me2e_compress.evaluators import Drive
from me2e_compress.evaluators.highway.observe import cameras_of
from me2e_compress.evaluators.highway.runner import drive
from me2e_compress.simulator.camera_rig import CLEAR, CameraRig
from me2e_compress.simulator.cameras.ground import paint_texture
from me2e_compress.simulator.cameras.renderer import Cameras
from me2e_compress.simulator.scene import PixelClass, Scene
from me2e_compress.simulator.world import World
from models.driver.episodes import GRID, Collection, decode
from models.driver.episodes.birdseye import bev_classes
from models.driver.episodes.collecting import episode_of
from models.driver.episodes.collection import Task, tasks_of
from models.driver.episodes.episode_arrays import Arrays, arrays_of
from models.driver.episodes.recording_policy import (
    Perturbation,
    RecordingPolicy,
)
from models.driver.expert.expert_policy import Expert, ceiling
from models.tests.driver.beginning import drive_beginning

pytestmark = pytest.mark.xdist_group("episodes")

SIZE = (24, 40)
CALM = Collection(seed=3, variants=1, every=20, image_size=SIZE, noise=0.0)
NOISY = replace(CALM, noise=1.0)
STOP = "VanillaNonSignalizedTurnEncounterStopsign"


def task(scenario: str) -> Task:
    (found,) = (one for one in tasks_of(CALM) if one.scenario == scenario)
    return found


@dataclass
class Witness(Expert):
    """The expert itself, and everything it was shown."""

    seen: list[Observation] = field(default_factory=list)
    plans: list[Plan] = field(default_factory=list)

    def plan(self, observation: Observation) -> Plan:
        self.seen.append(observation)
        self.plans.append(super().plan(observation))
        return self.plans[-1]


@pytest.fixture(scope="module")
def calm() -> Arrays:
    arrays = episode_of(CALM, task(STOP), None)
    assert arrays is not None
    return arrays


@pytest.fixture(scope="module")
def noisy() -> Arrays:
    arrays = episode_of(NOISY, task("T_Junction"), None)
    assert arrays is not None
    return arrays


@pytest.fixture(scope="module")
def witness() -> Witness:
    policy = Witness()
    drive(task(STOP).route(), policy, Drive())
    return policy


@pytest.fixture(scope="module")
def world(witness: Witness) -> World:
    found = witness.seen[0].world
    assert isinstance(found, World)
    return found


def scenes(witness: Witness) -> list[Scene]:
    return [seen.scene for seen in witness.seen if isinstance(seen.scene, Scene)]


def test_without_noise_the_expert_drives_as_ever(
    calm: Arrays, witness: Witness
) -> None:
    poses = [(s.ego.x, s.ego.y, s.ego.heading) for s in scenes(witness)]
    told = np.array([seen.can_bus for seen in witness.seen[::20]])
    moved = [0, 1, 2, 17]  # what depends on the spacing

    assert np.array_equal(calm["pose"], poses[::20])
    assert np.array_equal(calm["plan"], np.array(witness.plans[::20], np.float32))
    assert np.array_equal(calm["time_us"], [s.time_us for s in scenes(witness)[::20]])
    assert np.array_equal(calm["command"], [o.command for o in witness.seen[::20]])
    assert np.all(calm["can_bus"][:, moved] == 0.0)
    assert np.array_equal(
        np.delete(calm["can_bus"], moved, 1), np.delete(told, moved, 1)
    )
    assert not calm["crashed"]


def test_seconds_since_the_ego_stood(calm: Arrays, witness: Witness) -> None:
    speeds = np.array([s.ego.speed_mps for s in scenes(witness)])
    expected = []
    for frame in range(0, len(speeds), 20):
        stood = np.flatnonzero(speeds[: frame + 1] < 0.1)
        expected.append(60.0 if len(stood) == 0 else (frame - stood[-1]) * 0.05)

    assert 0.0 < min(calm["rest_s"][calm["rest_s"] > 0]) < 60.0  # it did stop
    assert calm["rest_s"] == pytest.approx(expected)


def test_pictures_come_back(calm: Arrays, witness: Witness, world: World) -> None:
    texture = paint_texture(world.roadmap, world.path.points)
    cameras = Cameras(texture, CameraRig(*SIZE))
    index = len(calm["time_us"]) // 2
    begin, end = calm["jpeg_offsets"][index : index + 2]

    decoded = decode(calm["jpeg"][begin:end])

    expected = cameras.render(scenes(witness)[20 * index])
    assert decoded.shape == (6, *SIZE, 3)
    error = np.abs(decoded.astype(int) - expected.astype(int))
    assert error.mean() < 3.0
    # red and blue are not swapped: the sky is blue
    assert decoded[0, 0, 0, 2] > decoded[0, 0, 0, 0] + 50


def test_the_path_is_the_route_in_the_ego_frame(
    calm: Arrays, witness: Witness, world: World
) -> None:
    for row, scene in enumerate(scenes(witness)[::20]):
        cos, sin = np.cos(scene.ego.heading), np.sin(scene.ego.heading)
        turn = np.array([[cos, sin], [-sin, cos]])
        back = calm["path"][row] @ turn + (scene.ego.x, scene.ego.y)
        s, lateral = world.path.project(scene.ego.x, scene.ego.y)
        reach = int(min(s + 48.0, world.path.length_m) - s) // 2
        for k in range(reach):
            at, away = world.path.project(float(back[k, 0]), float(back[k, 1]))
            assert at == pytest.approx(s + 2.0 * k, abs=0.35)
            assert away == pytest.approx(0.0, abs=0.05)
        assert calm["lateral_m"][row] == pytest.approx(lateral, abs=1e-4)
    # straight on, beyond its end
    steps = np.diff(calm["path"][-1], axis=0)
    assert np.hypot(steps[:, 0], steps[:, 1]) == pytest.approx(2.0, abs=0.1)


def test_attributes_of_the_path(calm: Arrays, world: World) -> None:
    path, row = world.path, 3
    s, _ = path.project(*map(float, calm["pose"][row, :2]))
    at = s + 2.0 * np.arange(25)

    left, right, oncoming, top = calm["path_attributes"][row].T

    assert left == pytest.approx(path.value(path.left_m, at), abs=1e-4)
    assert right == pytest.approx(path.value(path.right_m, at), abs=1e-4)
    assert oncoming == pytest.approx(path.value(path.oncoming_m, at), abs=1e-4)
    assert top == pytest.approx(path.value(ceiling(path), at), abs=1e-4)


def test_the_ground_has_neither_ego_nor_actors(
    calm: Arrays, witness: Witness, world: World
) -> None:
    texture = paint_texture(world.roadmap, world.path.points)
    scene = replace(scenes(witness)[0], actors=())
    under_ego = bev_classes(scene, texture, GRID) == PixelClass.EGO

    expected = bev_classes(scene, texture, GRID)
    ground = calm["ground"][0]

    assert np.array_equal(ground[~under_ego], expected[~under_ego])
    assert set(ground[under_ego].tolist()) <= {
        PixelClass.DRIVABLE,
        PixelClass.LANE_MARKING,
    }


def test_the_plan_alone_ignores_everybody() -> None:
    busy = episode_of(CALM, task("HardBreakRoute"), None)
    assert busy is not None
    ahead = np.hypot(*busy["plan"][:, -1].T)
    alone = np.hypot(*busy["plan_alone"][:, -1].T)

    assert np.max(alone - ahead) > 5.0  # it brakes for its leader
    assert np.min(alone - ahead) > -1.0


def test_the_plan_alone_obeys_signals(calm: Arrays) -> None:
    unserved = (calm["signals"][:, 0, 0] == 1) & (calm["signals"][:, 0, 7] == 0)
    gap = calm["signals"][:, 0, 6]
    before = unserved & (gap > 3.5)  # the front is 2.5 m ahead of the centre
    reach = calm["plan_alone"][before, -1, 0]

    assert np.any(gap[before] < 15.0)
    assert np.all(reach <= gap[before] - 2.5)


def test_futures_are_known_until_the_end(calm: Arrays) -> None:
    # a sample a second: the last second of frames knows the fewest
    known = calm["known_steps"]

    assert np.all(known[:-4] == 6)
    assert np.all(np.diff(known[-4:]) <= 0)
    assert known[-1] <= 2


STRAIGHT = 8
"""Samples before the junction."""


def test_noise_leaves_the_route(noisy: Arrays) -> None:
    calm = episode_of(CALM, task("T_Junction"), None)
    assert calm is not None

    # where the road is straight: in the junction the expert itself cuts the corner
    calm_m, noisy_m = (np.abs(a["lateral_m"][:STRAIGHT]) for a in (calm, noisy))
    assert calm_m.max() + 0.1 < noisy_m.max()


@dataclass
class Overheard(RecordingPolicy):
    """A recording, and what it answered."""

    answers: list[Plan] = field(default_factory=list)

    def plan(self, observation: Observation) -> Plan:
        self.answers.append(super().plan(observation))
        return self.answers[-1]


def test_what_is_driven_is_the_label_with_noise() -> None:
    policy, route = Overheard(seed=3), task("HighwayExit").route()
    drive(route, policy, Drive())
    seeds = [3, zlib.crc32(route.id.encode())]
    noise = Perturbation(np.random.default_rng(seeds), 1.0)

    for frame, answer in zip(policy.frames, policy.answers, strict=True):
        label = frame.decision.waypoints
        assert np.array_equal(answer, noise.apply(label, frame.scene.time_us))
    labels = [frame.decision.waypoints for frame in policy.frames]
    assert not np.array_equal(labels, policy.answers)


def test_every_route_is_its_own_noise(noisy: Arrays) -> None:
    again = episode_of(NOISY, replace(task("T_Junction"), name="other"), None)

    assert again is not None
    assert not np.array_equal(noisy["pose"][:4], again["pose"][:4])


def test_a_recorded_picture_shows_the_weather() -> None:
    tasks = tasks_of(replace(CALM, scenarios=("HighwayExit",), variants=12))
    dark = next(e for e in tasks if World(e.route()).weather.night > 0.5)
    policy = RecordingPolicy(seed=3)
    drive_beginning(dark.route(), policy, 100_000)
    assert policy.world is not None
    cameras = cameras_of(policy.world, CameraRig(*SIZE))

    arrays = arrays_of(policy.world, policy.top, policy.frames, 20, SIZE)

    expected = cameras.render(policy.frames[0].scene).astype(int)
    in_daylight = Cameras(cameras.texture, cameras.rig, CLEAR)
    by_day = in_daylight.render(policy.frames[0].scene)
    found = decode(arrays["jpeg"]).astype(int)
    assert np.abs(found - expected).mean() < 3.0
    assert np.abs(by_day - expected).mean() > 20.0
