import json
import sys
from pathlib import Path

import numpy as np
import pytest

from me2e_compress.errors import EvaluationError, MissingPackageError
from me2e_compress.evaluators.carla import graph_agent
from tests.evaluators.carla.small_leaderboard import (
    SAVE_NAME,
    Leaderboard,
    RoadOption,
    VehicleControl,
    written,
)
from tests.evaluators.highway.drivers import straight_on


def test_a_graph_drives(board: Leaderboard, tmp_path: Path) -> None:
    model = straight_on(tmp_path / "m.onnx")
    board.noise = 0.0

    agent = board.drive(graph_agent, str(model), 80)

    assert board.world.speed == pytest.approx(4.0, abs=0.5)
    assert abs(board.world.y) < 0.3
    assert agent.step == 79
    assert all(isinstance(each, VehicleControl) for each in board.returned)
    kinds = {each["type"] for each in agent.sensors()}
    assert "sensor.camera.rgb" not in kinds  # the model takes no images


def test_the_route_turns_the_wheel(board: Leaderboard, tmp_path: Path) -> None:
    model, board.noise = straight_on(tmp_path / "m.onnx"), 0.0
    # CARLA's y points to the south: the route bends to the right
    bend = [(float(k), 0.1 * k * k, RoadOption.RIGHT) for k in range(0, 12, 3)]

    board.drive(graph_agent, str(model), 20, bend)

    assert board.world.yaw_deg > 0.0
    assert board.seen[-1][1] > 0.0


CONTROLS = """
[control]
throttle = "gas[0]"
steer = "gas[1]"
"""


@pytest.mark.parametrize(
    ("more", "throttle"), [("", 0.25), ("[fusion]\n", 0.7 * 0.75 + 0.3 * 0.25)]
)
def test_a_graph_of_controls_presses_as_it_says(
    board: Leaderboard, tmp_path: Path, more: str, throttle: float
) -> None:
    """As they are, or fused with the plan, whose throttle is 0.75."""
    model = straight_on(
        tmp_path / "m.onnx",
        outputs="float[1, 6, 2] plan, float[2] gas",
        body="plan = Identity (ahead) gas = Identity (asked)",
        initializers=", float[2] asked = {0.25, 0.5}",
    )
    adapter = written(tmp_path / "a.toml", CONTROLS + more)
    conf = f'model = "{model}"\nadapter = "{adapter}"'
    board.noise = 0.0

    board.drive(graph_agent, str(written(tmp_path / "g.toml", conf)), 1)

    (control,) = board.returned
    assert (control.throttle, control.brake) == pytest.approx((throttle, 0.0))
    assert (control.steer == 0.5) is (not more)


def test_metric_info_is_written_where_the_leaderboard_looks(
    board: Leaderboard, tmp_path: Path
) -> None:
    model = straight_on(tmp_path / "m.onnx")
    conf = f'model = "{model}"\nfolder = "{tmp_path / "saved"}"\n'

    board.drive(graph_agent, str(written(tmp_path / "g.toml", conf)), 6)

    path = tmp_path / "saved" / SAVE_NAME / "metric_info.json"
    assert list(json.loads(path.read_text())) == ["0", "1", "2", "3", "4", "5"]


def test_a_plan_that_is_not_finite_ends_the_route(
    board: Leaderboard, tmp_path: Path
) -> None:
    agent = board.make(graph_agent, str(straight_on(tmp_path / "m.onnx")))
    agent._policy.plan = lambda observation: np.full((6, 2), np.nan)

    with pytest.raises(EvaluationError, match="step 0: the plan is not finite"):
        board.run(agent, 2)


@pytest.mark.parametrize(
    ("conf", "words"),
    [
        ('model = "none.onnx"', "model none.onnx: no such file"),
        ('model = "m.onnx"\njpeg_quality = 101', "jpeg_quality"),
        ('model = "m.onnx"\n[[cameras]]\nid = "A"\nx = 0\ny = 0\nyaw = 0', "cameras"),
        ('model = "m.onnx"\n[pid]\nturn_kq = 1', "pid.turn_kq"),
        ('model = "m.onnx"\n[pid]\nmax_throttle = -1.0', "pid.max_throttle"),
        ('model = "m.onnx"\n[pid]\nturn_kp = nan', "pid.turn_kp"),
        ("model = ", "not options of an agent"),
    ],
)
def test_bad_options_are_one_line(
    board: Leaderboard, tmp_path: Path, conf: str, words: str
) -> None:
    path = written(tmp_path / "bad.toml", conf)

    with pytest.raises(EvaluationError, match=words) as caught:
        board.make(graph_agent, f"{path}+{SAVE_NAME}")

    assert "\n" not in str(caught.value)


def test_without_carla_or_leaderboard_the_message_says_so(
    board: Leaderboard, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent = graph_agent.GraphAgent("localhost", 2000)
    conf = str(straight_on(tmp_path / "m.onnx"))
    monkeypatch.setitem(sys.modules, "leaderboard", None)
    monkeypatch.delitem(sys.modules, "leaderboard.autoagents")
    monkeypatch.delitem(sys.modules, "leaderboard.autoagents.autonomous_agent")
    with pytest.raises(EvaluationError, match="on PYTHONPATH"):
        agent.setup(conf)

    monkeypatch.setitem(sys.modules, "carla", None)
    with pytest.raises(MissingPackageError, match="carla is not installed"):
        agent.setup(conf)
    agent.destroy()


def test_no_file_hides_a_module_of_the_leaderboard() -> None:
    """The leaderboard puts the folder of an agent's file first on the path."""
    here = Path(graph_agent.__file__).parent
    names = {each.stem for each in here.glob("*.py")} - {"__init__"}

    theirs = {"agents", "carla", "leaderboard", "planner", "pid_controller", "srunner"}
    assert not names & (theirs | set(sys.stdlib_module_names))
