"""What a graph is told in CARLA: motion, aims and images, as the contract says."""

import json
import math
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from agent_files import options, straight_on
from me2e_compress.driving.contract import six_waypoints
from small_leaderboard import SAVE_NAME, Leaderboard, RoadOption, World

IMAGE = json.dumps({"mean": [10, 20, 30], "std": [1, 1, 1], "order": "bgr"})
ECHO = {
    "inputs": "float[18] can_bus, int64[1] command, float[1] timestamp",
    "body": """
        told = Cast <to = 1> (command)
        all = Concat <axis = 0> (can_bus, told, timestamp)
        some = Gather (all, picked)
        plan = Reshape (some, plan_shape)""",
    "initializers": """, int64[3] plan_shape = {1, 6, 2},
        int64[12] picked = {0, 1, 3, 6, 7, 10, 11, 12, 15, 17, 18, 19}""",
}
"""What a model is told comes back as its plan: metres moved, quaternion, speed,
acceleration, yaw rate, degrees turned, command, seconds."""


@pytest.fixture
def echo(tmp_path: Path) -> Path:
    return straight_on(tmp_path / "echo.onnx", **ECHO)  # type: ignore[arg-type]


def heard(agent: Any) -> list[np.ndarray]:
    """Keep what the model answers; what drives is a plan at 4 m/s."""
    found = list[np.ndarray]()
    model = agent._policy.plan

    def plan(observation: Any) -> np.ndarray:
        found.append(six_waypoints(model(observation)).reshape(-1))
        return np.stack([2.0 * np.arange(1, 7), np.zeros(6)], axis=1)

    agent._policy.plan = plan
    return found


def test_a_model_is_told_what_the_contract_says(
    board: Leaderboard, graph_agent: ModuleType, echo: Path
) -> None:
    agent = board.make(graph_agent, f"{options(echo)}+{SAVE_NAME}")
    found, worlds = heard(agent), list[World]()
    board.world.yaw_deg, board.world.speed = 30.0, 5.0

    def steer(world: World) -> None:
        worlds.append(World(**vars(world)))

    board.run(agent, 4, steer)

    last, now, bus = worlds[-2], worlds[-1], found[-1]
    heading = -math.radians(now.yaw_deg)
    assert bus[:2] == pytest.approx((now.x - last.x, last.y - now.y), abs=1e-3)
    assert bus[2:4] == pytest.approx((math.cos(heading / 2), math.sin(heading / 2)))
    assert bus[4] == pytest.approx(now.speed)
    assert bus[5:8] == pytest.approx((now.acceleration, 0.0, 9.81), abs=1e-5)
    assert bus[8] == pytest.approx(-math.radians(now.turn_deg), abs=1e-6)
    assert bus[9] == pytest.approx(last.yaw_deg - now.yaw_deg, abs=1e-4)
    assert now.yaw_deg > last.yaw_deg  # clockwise in CARLA, so less than zero here
    assert bus[10:] == pytest.approx((3.0, 0.15))


AIMS = """
axes = "forward-right"
[feeds.aims]
parts = [{ source = "target-point" }, { source = "target-point", which = "far" }]
"""


def test_a_model_is_told_what_to_aim_at(
    board: Leaderboard, graph_agent: ModuleType, tmp_path: Path
) -> None:
    """Nodes every 20 m to the east, 2 m to the right of where it starts."""
    model = straight_on(
        tmp_path / "m.onnx",
        inputs="float[4] aims",
        body="some = Gather (aims, picked) plan = Reshape (some, plan_shape)",
        initializers=""", int64[3] plan_shape = {1, 6, 2},
            int64[12] picked = {0, 1, 2, 3, 0, 0, 0, 0, 0, 0, 0, 0}""",
    )
    conf = options(model, AIMS)
    board.noise = 0.0
    route = [(20.0 * k, 2.0, RoadOption.LANEFOLLOW) for k in range(1, 6)]
    agent = board.make(graph_agent, f"{conf}+{SAVE_NAME}", route)
    found = heard(agent)

    board.run(agent, 4)  # in the first frames there is no compass

    # as a plan, so to the left
    np.testing.assert_allclose(found[-1][:4], [40.0, -2.0, 60.0, -2.0], atol=2.0)


def test_the_first_decision_has_nothing_before_it(
    board: Leaderboard, graph_agent: ModuleType, echo: Path
) -> None:
    agent = board.make(graph_agent, f"{options(echo)}+{SAVE_NAME}")
    found = heard(agent)

    board.run(agent, 1)

    assert found[0][[0, 1, 9, 11]] == pytest.approx([0.0] * 4)
    # the compass sends nan at first: as if it faced north
    assert found[0][2:4] == pytest.approx([math.sqrt(0.5)] * 2)


def test_the_can_bus_counts_from_the_last_decision(
    board: Leaderboard, graph_agent: ModuleType, echo: Path
) -> None:
    conf = options(echo, latency="fps:5")
    agent = board.make(graph_agent, f"{conf}+{SAVE_NAME}")
    found, places = heard(agent), list[float]()
    board.world.speed = 20.0

    board.run(agent, 9, lambda world: places.append(world.x))
    agent.destroy()

    moved = [each[0] for each in found]
    assert moved[1:] == pytest.approx(
        [places[4] - places[0], places[8] - places[4]], abs=1e-3
    )
    assert [each[11] for each in found] == pytest.approx([0.0, 0.2, 0.4])
    assert agent.step == 8
    kept = json.loads((agent.save_path / "metric_info.json").read_text())
    assert len(kept) == 9


SEES = {
    "inputs": "float[1, 6, 3, 16, 16] img",
    "body": """
        flat = Reshape (img, everything)
        some = Gather <axis = 1> (flat, picked)
        plan = Reshape (some, plan_shape)""",
    "initializers": """, int64[2] everything = {1, -1}, int64[3] plan_shape = {1, 6, 2},
        int64[12] picked = {0, 256, 512, 240, 496, 752, 0, 0, 0, 0, 0, 0}""",
}
AHEAD = """
[images.img]
cameras = ["FRONT"]
camera_size = [900, 1600]
rendered = [9, 16]
crop = [[0, 400, 1600, 900]]
mean = [0.0, 0.0, 0.0]
std = [1.0, 1.0, 1.0]
"""


def test_a_model_of_one_camera_mounts_no_other(
    board: Leaderboard, graph_agent: ModuleType, tmp_path: Path
) -> None:
    inputs = "float[1, 3, 5, 16] img"
    picked = "int64[12] picked = {0, 80, 160, 79, 159, 239, 0, 0, 0, 0, 0, 0}"
    parts = SEES["initializers"].partition("int64[12]")[0] + picked
    see = {"inputs": inputs, "body": SEES["body"], "initializers": parts}
    model = straight_on(tmp_path / "m.onnx", **see)  # type: ignore[arg-type]
    conf = options(model, AHEAD, jpeg_quality=0)
    agent = board.make(graph_agent, f"{conf}+{SAVE_NAME}")
    found = heard(agent)

    board.run(agent, 1)

    mounted = [each["id"] for each in agent.sensors() if "camera" in each["type"]]
    assert mounted == ["CAM_FRONT"]
    assert found[0][:6] == pytest.approx([200, 0, 0] * 2)  # red, as CARLA's here


@pytest.mark.parametrize(("quality", "off"), [(0, 0.0), (20, 12.0)])
def test_images_are_rgb_scaled_and_padded_with_the_mean(
    board: Leaderboard,
    graph_agent: ModuleType,
    tmp_path: Path,
    quality: int,
    off: float,
) -> None:
    model = straight_on(tmp_path / "m.onnx", metadata={"me2e.image": IMAGE}, **SEES)
    conf = options(model, jpeg_quality=quality)
    agent = board.make(graph_agent, f"{conf}+{SAVE_NAME}")
    found = heard(agent)

    board.run(agent, 1)

    # CARLA's picture is red; the model takes blue first, and 9 of its 16 rows
    assert found[0][:3] == pytest.approx([-10, -20, 170], abs=off)
    assert bool(off) != np.array_equal(found[0][:3], [-10, -20, 170])
    assert found[0][3:6] == pytest.approx([0.0, 0.0, 0.0])
