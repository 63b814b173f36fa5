import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from me2e_compress.errors import EvaluationError
from me2e_compress.simulator.world.environment import ENVIRONMENT, HighwayEnv
from tests.simulator.world.driving import route_of


def test_gymnasium_finds_nothing_wrong() -> None:
    env = HighwayEnv([route_of("EnterActorFlow", 1), route_of("Accident", 2)])

    check_env(env, skip_render_check=True)


def test_it_is_registered() -> None:
    env = gymnasium.make(ENVIRONMENT, routes=[route_of("Accident", 1)])
    observed, info = env.reset(seed=3)

    assert env.observation_space.contains(observed)
    assert info == {"route": "test", "scenario": "Accident"}


def test_reward_is_progress_and_a_collision_costs() -> None:
    env = HighwayEnv([route_of("Accident", 1)])
    env.reset(seed=0)
    rewards, push = list[float](), np.array([0.35, 0.0], np.float32)
    while True:
        _, reward, ended, late, info = env.step(push)
        rewards.append(reward)
        if ended or late:
            break

    assert rewards[-1] < -45
    assert 40 < sum(rewards[:-1]) < 90
    assert info["events"][-1] == "collision"


def test_a_route_is_picked_by_id() -> None:
    env = HighwayEnv([route_of("Accident", 1)])

    with pytest.raises(EvaluationError, match="no route 'other'; there are 1"):
        env.reset(options={"route": "other"})


def test_an_environment_must_be_reset_first() -> None:
    with pytest.raises(EvaluationError, match="has not been reset"):
        HighwayEnv([route_of()]).step(np.zeros(2, np.float32))
