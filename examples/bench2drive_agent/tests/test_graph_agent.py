"""A graph drives in the small leaderboard, with its latency."""

import json
from itertools import count
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from pydantic import ValidationError

from agent_files import options, straight_on
from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.realtime import ControlClock
from me2e_compress.evaluators.bench2drive.recordings import (
    read_decisions,
    read_recording,
)
from small_leaderboard import SAVE_NAME, Leaderboard, RoadOption, VehicleControl


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return straight_on(tmp_path / "m.onnx")


def test_a_graph_drives(
    board: Leaderboard, graph_agent: ModuleType, model: Path
) -> None:
    board.noise = 0.0

    agent = board.drive(graph_agent, options(model), 80)

    assert board.world.speed == pytest.approx(4.0, abs=0.5)
    assert abs(board.world.y) < 0.3
    assert agent.step == 79
    assert all(isinstance(each, VehicleControl) for each in board.returned)
    kinds = {each["type"] for each in agent.sensors()}
    assert "sensor.camera.rgb" not in kinds  # the model takes no images


def test_the_route_turns_the_wheel(
    board: Leaderboard, graph_agent: ModuleType, model: Path
) -> None:
    board.noise = 0.0
    # CARLA's y points to the south: the route bends to the right
    bend = [(float(k), 0.1 * k * k, RoadOption.RIGHT) for k in range(0, 12, 3)]

    board.drive(graph_agent, options(model), 20, bend)

    assert board.world.yaw_deg > 0.0
    assert board.seen[-1][1] > 0.0


def test_mirrored_latitudes_are_told_and_driven_by(
    board: Leaderboard,
    graph_agent: ModuleType,
    model: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    board.noise, board.world.y, board.world.mirrored = 0.0, 92.5, True
    route = [(20.0 * k, 92.5, RoadOption.LANEFOLLOW) for k in range(6)]

    agent = board.drive(graph_agent, options(model), 3, route)

    assert [each.message for each in caplog.records] == [
        "GPS latitudes are mirrored, as in CARLA 0.9.16"
    ]
    assert agent._motion(board.world.sensed()).y == pytest.approx(-92.5, abs=0.1)


def numbered(
    agent: object, monkeypatch: pytest.MonkeyPatch, module: ModuleType
) -> None:
    """Let the n-th decision press the throttle by n thousandths."""
    numbers = count(1)

    def decided(*_: object) -> object:
        return module.PedalsAndWheel(next(numbers) / 1000, 0.0, 0.0)

    monkeypatch.setattr(agent, "_decide", decided)


def acting(latencies_us: list[int], frames: int) -> list[float]:
    """Which decision acts in each frame, as the evaluator of highway-env has it."""
    clock, numbers, charged = ControlClock(0), count(1), iter(latencies_us)
    found = list[float]()
    for _ in range(frames):
        if clock.decision_is_due:
            clock.decide(next(numbers), next(charged))
        found.append(clock.advance() / 1000)
    return found


@pytest.mark.parametrize("seed", range(5))
def test_a_control_acts_when_equation_4_says(
    board: Leaderboard,
    graph_agent: ModuleType,
    model: Path,
    seed: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn = np.random.default_rng(seed).integers(0, 400_000, 24).tolist()
    trace = {"model_sha256": "", "machine": "", "samples_us": drawn}
    (model.parent / "trace.json").write_text(json.dumps(trace))
    latency = f"trace{{trace={model.parent / 'trace.json'}, in_order=true}}"
    agent = board.make(graph_agent, f"{options(model, latency=latency)}+{SAVE_NAME}")
    numbered(agent, monkeypatch, graph_agent)

    board.run(agent, 24)

    assert [throttle for throttle, _, _ in board.seen] == acting(drawn, 24)
    stands = [brake for throttle, _, brake in board.seen if not throttle]
    assert set(stands) <= {1.0}  # before the first control acts


def test_measured_latency_holds_the_control(
    board: Leaderboard,
    graph_agent: ModuleType,
    model: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    conf = options(model, latency="measured")
    agent = board.make(graph_agent, f"{conf}+{SAVE_NAME}")
    numbered(agent, monkeypatch, graph_agent)
    took_us = [20_000_000, 170_000, 30_000, 230_000, 0, 0, 0, 0, 0, 0]
    times = (time for took in took_us for time in (0, took * 1_000))
    monkeypatch.setattr(graph_agent.time, "perf_counter_ns", lambda: next(times))

    board.run(agent, 10)

    # the first decision warms up, and is charged nothing
    expected = acting([0, *took_us[1:]], 10)
    assert [throttle for throttle, _, _ in board.seen] == expected


def test_what_score_reads_is_written(
    board: Leaderboard, graph_agent: ModuleType, model: Path
) -> None:
    agent = board.drive(graph_agent, options(model, latency="fps:5"), 9)

    folder = model.parent / "saved" / SAVE_NAME
    assert agent.save_path == folder
    decisions = read_decisions(folder / "decisions.jsonl")
    assert [each.time_us for each in decisions] == [0, 200_000, 400_000]
    assert [each.latency_us for each in decisions] == [200_000] * 3
    recording = read_recording(json.loads((folder / "metric_info.json").read_text()))
    assert recording.steps.tolist() == list(range(9))


def test_a_plan_that_is_not_finite_ends_the_route(
    board: Leaderboard, graph_agent: ModuleType, model: Path
) -> None:
    agent = board.make(graph_agent, f"{options(model)}+{SAVE_NAME}")
    agent._policy.plan = lambda observation: np.full((6, 2), np.nan)

    with pytest.raises(EvaluationError, match="the plan is not finite"):
        board.run(agent, 2)


@pytest.mark.parametrize("option", ["width", "pid"])
def test_an_option_that_is_not_there_is_named(
    board: Leaderboard, graph_agent: ModuleType, model: Path, option: str
) -> None:
    conf = options(model, **{option: 3})

    with pytest.raises(ValidationError, match=option):
        board.make(graph_agent, f"{conf}+{SAVE_NAME}")
