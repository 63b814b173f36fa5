"""A student in turns with the expert: what it is shown, and what is driven."""

import json
import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from me2e_compress.driving.contract import Observation, Plan, RouteInfo
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.simulator.scene import Scene
from me2e_compress.simulator.world import World
from models.driver.episodes import Collection
from models.driver.episodes.collecting import episode_of
from models.driver.episodes.collection import Task, tasks_of
from models.driver.episodes.recording_policy import PlanInForce, RecordingPolicy
from models.tests.driver.beginning import drive_beginning
from tests.evaluators.highway.drivers import straight_on

pytestmark = pytest.mark.xdist_group("episodes")

CALM = Collection(seed=3, variants=1, every=20, image_size=(24, 40), noise=0.0)
STOP = "VanillaNonSignalizedTurnEncounterStopsign"


def task(scenario: str) -> Task:
    (found,) = tasks_of(replace(CALM, scenarios=(scenario,)))
    return found


def test_a_student_drives_and_the_expert_labels(tmp_path: Path) -> None:
    norm = {"input": "img", "mean": [0] * 3, "std": [1] * 3, "order": "rgb"}
    model = straight_on(
        tmp_path / "m.onnx",
        inputs="float[1, 6, 3, 24, 40] img",
        metadata={"me2e.image": json.dumps(norm)},
    )
    what = replace(CALM, expert_share=0.0, student="0" * 64)

    arrays = episode_of(what, task(STOP), OnnxPolicy.open(model))

    assert arrays is not None
    # 4 m/s straight on, across the stop line and off the road
    assert arrays["can_bus"][6:, 7] == pytest.approx(4.0, abs=0.4)
    reach = np.hypot(*arrays["plan"][:, -1].T)
    assert np.ptp(reach) > 3.0


def test_turns_are_shared(tmp_path: Path) -> None:
    model = straight_on(tmp_path / "m.onnx")
    halves = replace(CALM, expert_share=0.5, student="0" * 64)
    quick = task("HighwayExit")

    shared = episode_of(halves, quick, OnnxPolicy.open(model))

    assert shared is not None
    speed = shared["can_bus"][:, 7]
    alone = replace(halves, expert_share=0.0)
    slow = episode_of(alone, quick, OnnxPolicy.open(model))
    assert slow is not None
    assert speed.max() > 6.0  # the expert's turns
    assert np.min(np.diff(speed)) < -1.5  # the student's


class Ahead:
    """Plans 4 m/s straight on, and keeps what it was shown."""

    needs_images, privileged = False, False

    def __init__(self) -> None:
        self.shown = list[Observation]()

    def reset(self, route: RouteInfo) -> None:
        self.shown.clear()

    def plan(self, observation: Observation) -> Plan:
        self.shown.append(observation)
        return np.stack([np.arange(2.0, 14.0, 2.0), np.zeros(6)], axis=1)


def test_a_student_decides_at_the_stored_samples() -> None:
    student = Ahead()
    policy = RecordingPolicy(3, 0.0, 0.0, student, every=4)

    drive_beginning(task("HighwayExit").route(), policy, 1_000_000)

    assert [each.time_us for each in student.shown] == list(
        range(0, 1_000_000, 200_000)
    )
    # it is told of the way since its own last decision, not since the last frame
    poses = [each.scene.ego for each in policy.frames[::4]]
    moved = [math.dist((a.x, a.y), (b.x, b.y)) for a, b in pairwise(poses)]
    told = [float(np.hypot(*each.can_bus[:2])) for each in student.shown[1:]]
    assert told == pytest.approx(moved, abs=1e-4)
    assert min(moved) > 0.5


def test_a_plan_in_force_stays_where_it_was_made() -> None:
    ego = replace(World(task("HighwayExit").route()).scene().ego, heading=0.7)
    then = Scene(0, ego, (), ())
    ahead = np.array([0.4 * math.cos(0.7), 0.4 * math.sin(0.7)])
    moved = replace(ego, x=ego.x + ahead[0], y=ego.y + ahead[1])
    plan = np.stack([np.arange(2.0, 14.0, 2.0), np.zeros(6)], axis=1)

    on_course = PlanInForce(then, plan).seen_at(Scene(100_000, moved, (), ()))
    standing = PlanInForce(then, plan).seen_at(Scene(100_000, ego, (), ()))

    assert on_course == pytest.approx(plan)
    assert standing == pytest.approx(plan + np.array([0.4, 0.0]))
