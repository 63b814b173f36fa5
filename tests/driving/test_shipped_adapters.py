"""The adapters that ship: how they feed a graph."""

from pathlib import Path

import numpy as np
import pytest

from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.adapter import Adapter
from me2e_compress.driving.adapter.adapter import ModelInputs
from me2e_compress.driving.contract import Trajectory, check_answer
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.driving.shipped_adapters import adapter_file, shipped_adapters
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.runtime.session import Session
from models.stacks import STACKS, TCP, VAD_TINY
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


def test_tcps_waypoints_are_turned_to_ours(tcp: Path) -> None:
    policy = OnnxDriver(tcp, Path("tcp")).open()

    assert isinstance(policy, OnnxPolicy)
    assert policy.image_size == (288, 512)
    assert policy.adapter.to_ego(np.array([[8.0, 3.0]])).tolist() == [[8.0, -3.0]]
    pictures = np.zeros((6, 288, 512, 3), np.uint8)
    policy.reset(EXIT)
    still = motion(0.0, 0.0, 0.0, speed=0.0)
    result = check_answer(policy.plan(observation(still, images=pictures)))
    assert isinstance(result, Trajectory)
    assert result.times_s.tolist() == [0.5, 1.0, 1.5, 2.0]


def test_vad_tiny_is_fed_as_nuscenes_feeds_it(tmp_path: Path) -> None:
    ports = ", ".join(f"float{list(at)} {k}" for k, at in VAD_TINY.inputs.items())
    model = straight_on(
        tmp_path / "m.onnx",
        inputs=ports,
        body="bev_embed = Identity (prev_bev) ego_fut_preds = Identity (steps)",
        outputs="float[10000, 1, 256] bev_embed, float[1, 3, 6, 2] ego_fut_preds",
        initializers=f", float[1, 3, 6, 2] steps = {{{'1, ' * 35} 1}}",
    )

    policy = OnnxDriver(model, Path("vad-tiny")).open()

    assert isinstance(policy, OnnxPolicy)
    assert policy.image_size == (360, 640)
    assert policy.recurrent == dict(VAD_TINY.recurrent)
    norm = policy.inputs.images["img"].normalization
    assert norm is not None
    assert (norm.mean, norm.std) == (VAD_TINY.image.mean, VAD_TINY.image.std)
    assert policy.inputs.images["img"].indices == (0, 2, 1, 3, 4, 5)


def test_uniad_tiny_is_told_where_its_lidar_is(tmp_path: Path) -> None:
    stack = STACKS["uniad-tiny"]
    ports = [
        f"{'int64' if name in stack.dtypes else 'float'}{list(shape)} {name}"
        for name, shape in stack.inputs.items()
        if name not in stack.recurrent
    ]
    model = straight_on(tmp_path / "m.onnx", inputs=", ".join(ports))
    session = Session(model, threads=1)

    adapter = Adapter.load(adapter_file(Path("uniad-tiny")))
    inputs = ModelInputs.of(session, adapter, {})

    assert inputs.image_size == (900, 1600)
    assert set(inputs.sources) == set(session.inputs) - {"img"}


@pytest.mark.parametrize("name", shipped_adapters())
def test_what_ships_can_be_read(name: str) -> None:
    assert Adapter.load(adapter_file(Path(name))) != Adapter()


def test_a_file_of_that_name_wins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert adapter_file(Path("tcp")).name == "tcp.toml"
    Path("tcp").write_text("axes = 'forward-left'")

    assert adapter_file(Path("tcp")) == Path("tcp")


def test_no_such_adapter_names_those_that_ship() -> None:
    with pytest.raises(EvaluationError, match="adapter tpc: no such file; we ship"):
        adapter_file(Path("tpc"))
