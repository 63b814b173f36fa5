"""TCP driven by its control head, and by both heads as its agents fuse them."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.contract import Answer, PedalsAndWheel, check_answer
from me2e_compress.driving.latency import FixedLatency
from me2e_compress.evaluators import Drive
from me2e_compress.evaluators.highway.runner import drive
from models.export import export
from models.stacks import TCP
from models.tcp.config import ActionHeads
from models.tcp.policy import ACTIONS, best_action, likely_action, tcp_policy
from tests.driving.observed import motion, observation
from tests.evaluators.highway.drivers import EXIT, straight_on

ACTION = 6
"""Throttle 0.7, steer 0.1 of Bench2DriveZoo's 39."""


def scores(by_action: dict[int, float]) -> NDArray[np.float32]:
    return np.array([by_action.get(k, 0.0) for k in range(39)], np.float32)


@pytest.fixture
def tcp(tmp_path: Path) -> Path:
    """TCP's ports: the way straight ahead at 4 m/s, the sixth action, a Beta's mode."""
    ports = ", ".join(f"float{list(at)} {name}" for name, at in TCP.inputs.items())
    best = ", ".join(map(str, scores({ACTION: 1.0})))
    return straight_on(
        tmp_path / "tcp.onnx",
        inputs=ports,
        body="""pred_wp = Identity (ways) action_index = Identity (scores)
            mu_branches = Identity (mu) sigma_branches = Identity (sigma)""",
        outputs="float[1, 4, 2] pred_wp, float[1, 39] action_index,"
        " float[1, 2] mu_branches, float[1, 2] sigma_branches",
        initializers=f""", float[1, 4, 2] ways = {{2, 0, 4, 0, 6, 0, 8, 0}},
            float[1, 39] scores = {{{best}}},
            float[1, 2] mu = {{3, 2}}, float[1, 2] sigma = {{2, 2}}""",
    )


def answer(model: Path, heads: ActionHeads, *, fused: bool) -> Answer:
    """Ask at rest; the target point lies 20 m ahead, 5 m to the left."""
    policy = tcp_policy(model, heads, fused=fused)
    pictures = np.zeros((6, 288, 512, 3), np.uint8)
    policy.reset(EXIT)
    still = motion(0.0, 0.0, 0.0, speed=0.0)
    return check_answer(policy.plan(observation(still, images=pictures)))


@pytest.mark.parametrize(
    ("heads", "throttle", "steer"), [("bench2drive", 0.7, 0.1), ("beta", 1 / 3, 0.0)]
)
def test_the_control_head(
    tcp: Path, heads: ActionHeads, throttle: float, steer: float
) -> None:
    found = answer(tcp, heads, fused=False)

    assert found == pytest.approx((throttle, steer, 0.0))


def test_both_heads_as_bench2drives_agent_merges_them(tcp: Path) -> None:
    """The plan presses 0.75 and goes straight; starting it presses 0.5 at most."""
    found = answer(tcp, "bench2drive", fused=True)

    assert found == pytest.approx((0.5, 0.05, 0.0))


def test_both_heads_as_the_originals_agent_fuses_them(tcp: Path) -> None:
    """In its axes the way goes to the right, so the wheel follows the target point."""
    found = answer(tcp, "beta", fused=True)

    quarter_turns = -np.arctan2(5.0, 20.0) / (np.pi / 2)
    steer = 0.7 * quarter_turns * (0.75 + 0.75 / 40 + 0.3)
    assert isinstance(found, PedalsAndWheel)
    assert found == pytest.approx((0.7 * 0.75 + 0.3 / 3, steer, 0.0))


def test_a_file_of_other_heads_is_refused(tmp_path: Path) -> None:
    ports = ", ".join(f"float{list(at)} {name}" for name, at in TCP.inputs.items())
    model = straight_on(
        tmp_path / "m.onnx",
        inputs=ports,
        body="pred_wp = Identity (ways)",
        outputs="float[1, 4, 2] pred_wp",
        initializers=", float[1, 4, 2] ways = {2, 0, 4, 0, 6, 0, 8, 0}",
    )
    with pytest.raises(EvaluationError, match="no output mu_branches: it has other"):
        tcp_policy(model, "beta", fused=False)


@pytest.mark.slow
@pytest.mark.parametrize("fused", [False, True])
@pytest.mark.parametrize(
    ("heads", "latency_us"), [("bench2drive", 500_000), ("beta", 100_000)]
)
def test_tcp_drives_a_route_at_its_published_size(
    tmp_path: Path, heads: ActionHeads, latency_us: int, fused: bool
) -> None:
    """Weights are random: it gets nowhere, but no decision fails.

    By its Beta heads it collides within a second, so those decide more often.
    """
    policy = tcp_policy(
        export("tcp", tmp_path / "tcp.onnx", heads=heads), heads, fused=fused
    )
    conditions = Drive(FixedLatency(latency_us))

    episode = drive(EXIT, policy, conditions)

    assert episode.failure is None
    assert len(episode.decisions) > 3


@pytest.mark.parametrize(
    ("alpha", "beta", "acceleration"),
    [
        (3.0, 2.0, 1 / 3),  # the mode of Beta(3, 2) is 2/3
        (0.5, 2.0, -1.0),
        (2.0, 1.0, 1.0),
        (0.75, 0.25, 0.5),  # no mode: the mean 3/4
    ],
)
def test_tcp_takes_the_mode_of_a_beta_distribution(
    alpha: float, beta: float, acceleration: float
) -> None:
    found = likely_action(np.array([[alpha, 2.0]]), np.array([[beta, 2.0]]))

    assert found.throttle - found.brake == pytest.approx(acceleration)
    assert found.steer == 0.0


@given(st.tuples(*[st.floats(0, 1e6)] * 4))
def test_every_beta_distribution_is_in_range(four: tuple[float, ...]) -> None:
    throttle, steer, brake = likely_action(np.array(four[:2]), np.array(four[2:]))

    assert 0.0 <= throttle <= 1.0
    assert -1.0 <= steer <= 1.0
    assert 0.0 <= brake <= 1.0


def test_the_action_with_the_largest_score() -> None:
    assert best_action(scores({1: 0.9, 2: 0.9})) == PedalsAndWheel(0.7, -0.5, 0.0)
    assert len(set(ACTIONS)) == 39


@pytest.mark.parametrize("number", [-1.0, math.nan, math.inf])
def test_numbers_that_are_no_distribution(number: float) -> None:
    with pytest.raises(EvaluationError, match="no parameters of a Beta"):
        likely_action(np.array([1.0, number]), np.ones(2))


def test_outputs_that_are_no_control() -> None:
    with pytest.raises(EvaluationError, match="mu_branches has 1 numbers, it must h"):
        likely_action(np.ones(1), np.ones(2))
    with pytest.raises(EvaluationError, match="a score of action_index is not finite"):
        best_action(scores({3: math.nan}))
