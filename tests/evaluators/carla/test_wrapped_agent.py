"""Which agents can be wrapped, what stays their own, and what is refused."""

import sys
from pathlib import Path
from typing import Any

import pytest

from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.carla import real_time
from tests.evaluators.carla import small_leaderboard
from tests.evaluators.carla.small_leaderboard import SAVE_NAME, Leaderboard, written
from tests.evaluators.carla.wrapping import NUMBERED, config


def test_an_agent_without_a_cheap_part_has_its_steps_counted(
    board: Leaderboard, tmp_path: Path
) -> None:
    options = config(tmp_path, latency="fps:5", tick="")

    agent = board.drive(real_time, options, 6)

    assert (agent.step, agent.ticks) == (5, 2)
    assert list(agent.metric_info) == [0, 1, 2, 3, 4, 5]


def test_what_the_wrapper_lacks_is_the_agents_own(
    board: Leaderboard, tmp_path: Path
) -> None:
    agent = board.make(real_time, f"{config(tmp_path)}+one+{SAVE_NAME}")

    assert agent.conf == f"{tmp_path / 'saved'}+{SAVE_NAME}"
    assert agent._global_plan_world_coord[1][0].location.x == 20.0
    assert agent.sensors()[0]["id"] == "SPEED"
    with pytest.raises(AttributeError, match="no_such_thing"):
        _ = agent.no_such_thing


def test_another_rate_is_refused(
    board: Leaderboard, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(small_leaderboard, "DT_S", 0.1)

    with pytest.raises(EvaluationError, match=r"ticked 0.100 s"):
        board.drive(real_time, config(tmp_path), 2)


def test_an_agent_of_the_official_leaderboard_has_no_metrics(
    board: Leaderboard, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = sys.modules["leaderboard.autoagents.autonomous_agent"].AutonomousAgent
    monkeypatch.delattr(base, "get_metric_info")
    source = NUMBERED.read_text().replace("self.get_metric_info()", "{}", 1)
    source = source.replace("self.metric_info[self.step] = {}", "pass")
    plain = written(tmp_path / "plain_agent.py", source)

    agent = board.drive(real_time, config(tmp_path, agent=str(plain)), 4)

    assert not (agent.save_path / "metric_info.json").exists()


BAD: list[tuple[dict[str, Any], str]] = [
    ({"latency": "fps:0"}, "not a positive number"),
    ({"latency": "trace:none.json"}, "none.json: No such file"),
    ({"agent": "no_agent.py"}, "agent no_agent.py: no such file"),
    ({"agent": "json"}, "agent json has no get_entry_point"),
    ({"tick": "see"}, "has no method see"),
    ({"synchronize": "json:wait"}, "synchronize 'json:wait'"),
    ({"colour": "red"}, "colour"),
    ({"model": "none.pth"}, "model none.pth: no such file"),
    ({"latency_model": "guess"}, "latency_model"),
]


@pytest.mark.parametrize(("options", "words"), BAD)
def test_what_cannot_be_wrapped_is_one_line(
    board: Leaderboard, tmp_path: Path, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(EvaluationError, match=words) as caught:
        board.make(real_time, f"{config(tmp_path, **options)}+{SAVE_NAME}")

    assert "\n" not in str(caught.value)


def test_a_set_up_that_failed_can_be_destroyed(
    board: Leaderboard, tmp_path: Path
) -> None:
    agent = real_time.RealTimeAgent("localhost", 2000)
    with pytest.raises(EvaluationError):
        agent.setup(str(tmp_path / "none.toml"))

    agent.destroy()
