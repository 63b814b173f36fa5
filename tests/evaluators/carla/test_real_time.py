import hashlib
import json
import re
import sys
import tempfile
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.driving.realtime import DT_US, LatencyModel, control_clock
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.bench2drive.real_results import Bench2DriveResults
from me2e_compress.evaluators.carla import real_time
from me2e_compress.runtime.latency_trace import LatencyTrace
from tests.evaluators.bench2drive.files import checkpoint, record, write
from tests.evaluators.carla.small_leaderboard import (
    SAVE_NAME,
    Leaderboard,
    installed,
    written,
)
from tests.evaluators.carla.wrapping import NUMBERED, config
from tests.profiles import scaled

BRAKING = (0.0, 0.0, 1.0)


def trace(folder: Path, latencies_us: list[int]) -> str:
    text = json.dumps({"model_sha256": "", "machine": "", "samples_us": latencies_us})
    return f"trace:{written(folder / 'trace.json', text)}"


def acting(latencies_us: list[int], model: LatencyModel, frames: int) -> list[int]:
    """Which decision acts in each frame, as the evaluator of highway-env has it."""
    clock, numbers = control_clock(model, 0, DT_US), count(1)
    charged, found = iter(latencies_us), list[int]()
    for _ in range(frames):
        if clock.decision_is_due:
            clock.decide(next(numbers), next(charged))
        found.append(clock.advance())
    return found


def seen_as(decision: int) -> tuple[float, float, float]:
    return (0.5, 0.001 * decision, 0.0) if decision else BRAKING


@given(
    st.lists(st.integers(0, 400_000), min_size=24, max_size=24),
    st.sampled_from(LatencyModel),
)
@settings(max_examples=scaled(25))
def test_a_control_acts_when_the_evaluators_rule_says(
    latencies_us: list[int], model: LatencyModel
) -> None:
    with tempfile.TemporaryDirectory() as name, pytest.MonkeyPatch.context() as patch:
        board, folder = installed(patch), Path(name)
        patch.delitem(sys.modules, NUMBERED.stem, raising=False)
        latency = trace(folder, latencies_us)
        options = {"latency": latency, "in_order": True, "latency_model": model.value}

        agent = board.drive(real_time, config(folder, **options), 24)

    expected = acting(latencies_us, model, 24)
    assert board.seen == [seen_as(decision) for decision in expected]
    assert agent.ticks == 24


def test_measured_latency_holds_the_control(board: Leaderboard, tmp_path: Path) -> None:
    agent = board.make(real_time, f"{config(tmp_path)}+{SAVE_NAME}")
    took_us = [20_000_000, 170_000, 30_000, 230_000, 0, 0, 0, 0, 0, 0]
    times = (time for took in took_us for time in (0, took * 1_000))
    agent.now_ns = lambda: next(times)

    board.run(agent, 10)
    agent.destroy()

    # the first call warms up: it is charged nothing, and no sample of the trace
    expected = acting([0, *took_us[1:]], LatencyModel.DROP, 10)
    assert board.seen == [seen_as(decision) for decision in expected]
    kept = LatencyTrace.load(agent.save_path / "latency.json").samples_us
    assert kept == tuple(took_us[1 : agent.decisions])


@pytest.mark.parametrize("name", ["vad.onnx", "vad.pth"])
def test_the_trace_names_the_model(
    board: Leaderboard, tmp_path: Path, name: str
) -> None:
    model = written(tmp_path / name, "")
    options = config(tmp_path, model=str(model), machine="Orin, 30 W")

    agent = board.drive(real_time, options, 3)

    found = LatencyTrace.load(agent.save_path / "latency.json")
    assert found.model_sha256 == hashlib.sha256(b"").hexdigest()
    assert found.machine == "Orin, 30 W"


def test_every_decision_is_a_line(board: Leaderboard, tmp_path: Path) -> None:
    agent = board.drive(real_time, config(tmp_path, latency="fps:5"), 9)

    lines = (agent.save_path / "decisions.jsonl").read_text().splitlines()
    found = [json.loads(line) for line in lines]
    assert [each["frame"] for each in found] == [0, 4, 8]
    assert [each["latency_us"] for each in found] == [200_000] * 3
    assert [each["time_s"] for each in found] == pytest.approx([0.05, 0.25, 0.45])
    assert all(each["wall_s"] >= 0 for each in found)


def test_metric_info_has_every_frame(board: Leaderboard, tmp_path: Path) -> None:
    agent = board.drive(real_time, config(tmp_path, latency="fps:4"), 10)

    found = json.loads((agent.save_path / "metric_info.json").read_text())
    assert list(found) == [str(step) for step in range(10)]
    places = [each["location"][0] for each in found.values()]
    assert places == sorted(places)
    assert places[-1] == pytest.approx(board.world.x)


def test_the_reader_of_real_results_takes_what_is_left(
    board: Leaderboard, tmp_path: Path
) -> None:
    board.drive(real_time, config(tmp_path, latency="fps:5"), 60)
    route = record(1711, duration_s=3.0)
    assert route["save_name"] == SAVE_NAME
    write(tmp_path / "eval.json", checkpoint(route))

    found = Bench2DriveResults(tmp_path).collect()

    assert (found.unrecorded, dict(found.off_rate), dict(found.broken)) == ((), {}, {})
    assert len(found.episodes[0].frames) == 60
    # 200 ms skip three decisions
    decided_us = [one.time_us for one in found.episodes[0].decisions]
    assert decided_us == list(range(0, 3_000_000, 200_000))


def test_a_route_is_drawn_by_its_name_without_the_clock(
    board: Leaderboard, tmp_path: Path
) -> None:
    latency = trace(tmp_path, list(range(50_000, 450_000, 10_000)))
    found = []
    for start in ("06_16_22_20_36", "07_01_00_00_00"):
        name = re.sub(r"\d\d(_\d\d){4}$", start, SAVE_NAME)
        agent = board.make(real_time, f"{config(tmp_path, latency=latency)}+{name}")
        board.seen.clear()
        board.run(agent, 20)
        agent.destroy()
        found.append(list(board.seen))

    assert found[0] == found[1]


def test_the_gpu_is_waited_for_before_and_after(
    board: Leaderboard, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gpu, waited = ModuleType("a_gpu"), list[int]()
    made = list[Any]()
    monkeypatch.setattr(
        gpu, "wait", lambda: waited.append(made[0].decisions), raising=False
    )
    monkeypatch.setitem(sys.modules, "a_gpu", gpu)
    options = config(tmp_path, synchronize="a_gpu:wait")

    made.append(board.make(real_time, f"{options}+{SAVE_NAME}"))
    board.run(made[0], 2)

    assert waited == [0, 1, 1, 2]


def test_a_run_step_that_raises_leaves_trace_and_metrics(
    board: Leaderboard, tmp_path: Path
) -> None:
    agent = board.make(real_time, f"{config(tmp_path)}+{SAVE_NAME}")
    agent._inner.fails_at = 3

    with pytest.raises(RuntimeError, match="CUDA out of memory"):
        board.run(agent, 10)

    trace = LatencyTrace.load(agent.save_path / "latency.json")
    assert len(trace.samples_us) == 2
    assert len(json.loads((agent.save_path / "metric_info.json").read_text())) == 3
    agent.destroy()
    assert agent.gone


def test_routes_without_a_save_name_are_numbered(
    board: Leaderboard, tmp_path: Path
) -> None:
    source = NUMBERED.read_text().replace("exist_ok=False", "exist_ok=True")
    agent = str(written(tmp_path / "again_agent.py", source))
    options = config(tmp_path, agent=agent, folder=str(tmp_path / "traces"))
    for _ in range(2):
        made = board.make(real_time, options)
        board.run(made, 3)
        made.destroy()

    found = sorted(each.name for each in (tmp_path / "traces").iterdir())
    assert found == ["route-000", "route-001"]


def test_a_trace_is_not_written_over(board: Leaderboard, tmp_path: Path) -> None:
    source = NUMBERED.read_text().replace("exist_ok=False", "exist_ok=True")
    other = config(tmp_path, agent=str(written(tmp_path / "over_agent.py", source)))
    board.drive(real_time, other, 3)

    with pytest.raises(EvaluationError, match=r"decisions.jsonl: File exists"):
        board.drive(real_time, other, 3)


CROWD = "agents{source=none, per_agent_us=100000, range_m=30.0, fov_deg=90.0}"


def test_a_latency_may_depend_on_who_is_there(
    board: Leaderboard, tmp_path: Path
) -> None:
    board.world.yaw_deg = 90.0  # facing CARLA's +y
    board.world.put("vehicle.audi.tt", 0.0, 20.0)
    board.world.put("walker.pedestrian.0001", 5.0, 10.0)
    board.world.put("vehicle.audi.tt", 20.0, 0.0)  # to the left
    board.world.put("vehicle.audi.tt", 0.0, 40.0)  # far ahead
    board.world.put("traffic.traffic_light", 0.0, 10.0)

    agent = board.drive(real_time, config(tmp_path, latency=CROWD), 1)

    line = json.loads((agent.save_path / "decisions.jsonl").read_text())
    assert line["latency_us"] == 200_000


def test_without_a_hero_such_a_latency_is_refused(
    board: Leaderboard, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = NUMBERED.read_text().replace("fails_at = -1", "hero_actor = None")
    agent = str(written(tmp_path / "plain_agent.py", source))

    with pytest.raises(EvaluationError, match="does not tell where others are"):
        board.make(real_time, config(tmp_path, latency=CROWD, agent=agent))
