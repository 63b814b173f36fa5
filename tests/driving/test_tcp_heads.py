"""TCP's heads through the adapters that ship, on a graph of its ports."""

from pathlib import Path

import numpy as np
import pytest

from me2e_compress.driving.answer import checked
from me2e_compress.driving.contract import Answer, PedalsAndWheel, Trajectory
from me2e_compress.driving.latency import FixedLatency
from me2e_compress.evaluators.highway.conditions import Conditions
from me2e_compress.evaluators.highway.drivers import OnnxDriver, image_size_of
from me2e_compress.evaluators.highway.runner import drive
from me2e_compress.workflows.export import ExportOptions, export_stack
from me2e_compress.zoo.stacks import TCP
from tests.driving.observed import motion, observation
from tests.evaluators.highway.drivers import EXIT, straight_on

ACTION = 6
"""Throttle 0.7, steer 0.1 of Bench2DriveZoo's 39."""


@pytest.fixture
def tcp(tmp_path: Path) -> Path:
    """TCP's ports: the way straight ahead at 4 m/s, the sixth action, a Beta's mode."""
    ports = ", ".join(f"float{list(at)} {name}" for name, at in TCP.inputs.items())
    scores = ", ".join("1.0" if k == ACTION else "0.0" for k in range(39))
    return straight_on(
        tmp_path / "tcp.onnx",
        inputs=ports,
        body="""pred_wp = Identity (ways) action_index = Identity (scores)
            mu_branches = Identity (mu) sigma_branches = Identity (sigma)""",
        outputs="float[1, 4, 2] pred_wp, float[1, 39] action_index,"
        " float[1, 2] mu_branches, float[1, 2] sigma_branches",
        initializers=f""", float[1, 4, 2] ways = {{2, 0, 4, 0, 6, 0, 8, 0}},
            float[1, 39] scores = {{{scores}}},
            float[1, 2] mu = {{3, 2}}, float[1, 2] sigma = {{2, 2}}""",
    )


def answer(model: Path, adapter: str) -> Answer:
    """Ask at rest; the target point lies 20 m ahead, 5 m to the left."""
    policy = OnnxDriver(model, Path(adapter)).open()
    pictures = np.zeros((6, 288, 512, 3), np.uint8)
    policy.reset(EXIT)
    still = motion(0.0, 0.0, 0.0, speed=0.0)
    return checked(policy.plan(observation(still, images=pictures)))


def test_the_trajectory_head(tcp: Path) -> None:
    found = answer(tcp, "tcp")

    assert isinstance(found, Trajectory)
    assert found.times_s.tolist() == [0.5, 1.0, 1.5, 2.0]


@pytest.mark.parametrize(
    ("adapter", "throttle", "steer"),
    [("tcp-control", 0.7, 0.1), ("tcp-beta-control", 1 / 3, 0.0)],
)
def test_the_control_head(
    tcp: Path, adapter: str, throttle: float, steer: float
) -> None:
    assert answer(tcp, adapter) == pytest.approx((throttle, steer, 0.0))


def test_both_heads_as_bench2drives_agent_merges_them(tcp: Path) -> None:
    """The plan presses 0.75 and goes straight; starting it presses 0.5 at most."""
    assert answer(tcp, "tcp-fusion") == pytest.approx((0.5, 0.05, 0.0))


def test_both_heads_as_the_originals_agent_fuses_them(tcp: Path) -> None:
    """In its axes the way goes to the right, so the wheel follows the target point."""
    found = answer(tcp, "tcp-beta-fusion")

    quarter_turns = -np.arctan2(5.0, 20.0) / (np.pi / 2)
    steer = 0.7 * quarter_turns * (0.75 + 0.75 / 40 + 0.3)
    assert isinstance(found, PedalsAndWheel)
    assert found == pytest.approx((0.7 * 0.75 + 0.3 / 3, steer, 0.0))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("heads", "adapter", "latency_us"),
    [
        ("bench2drive", "tcp", 500_000),
        ("bench2drive", "tcp-control", 500_000),
        ("bench2drive", "tcp-fusion", 500_000),
        ("beta", "tcp-beta-control", 100_000),
        ("beta", "tcp-beta-fusion", 100_000),
    ],
)
def test_tcp_drives_a_route_at_its_published_size(
    tmp_path: Path, heads: str, adapter: str, latency_us: int
) -> None:
    """Weights are random: it gets nowhere, but no decision fails.

    By its Beta heads it collides within a second, so those decide more often.
    """
    model = tmp_path / "tcp.onnx"
    export_stack("tcp", model, ExportOptions(heads=heads))
    policy = OnnxDriver(model, Path(adapter)).open()
    conditions = Conditions(FixedLatency(latency_us), image_size=image_size_of(policy))

    episode = drive(EXIT, policy, conditions)

    assert episode.failure is None
    assert len(episode.decisions) > 3
