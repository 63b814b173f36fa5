"""The driver's network: what it exports is what it computes."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import onnx
import pytest
import torch

from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.runtime.session import Session
from me2e_compress.simulator.camera_rig import CameraRig
from models.driver.network.bev_encoder import RECORD, motion_of
from models.driver.network.config import HighwayConfig
from models.driver.network.stack import Highway, stood_lately
from models.stacks import HIGHWAY

Feeds = dict[str, npt.NDArray[np.generic]]

CELL = HighwayConfig().channels + RECORD
"""Numbers that the memory keeps of a cell."""


def inputs(rng: np.random.Generator, time_s: float = 0.4) -> Feeds:
    bus = np.zeros(18, np.float32)
    bus[:2], bus[16], bus[17] = rng.normal(0, 1, 2), rng.uniform(0, 6), rng.normal(0, 5)
    bus[7], bus[10:12], bus[15] = rng.uniform(0, 12), rng.normal(0, 1, 2), 0.1
    memory = rng.normal(0, 0.3, (1, 768, CELL)).astype(np.float32)
    # how well each cell is known, and how old that is
    memory[..., -RECORD:] = rng.uniform(0.3, 1.0, (1, 768, RECORD))
    return {
        "img": rng.normal(0, 1, (1, 6, 3, 96, 160)).astype(np.float32),
        "lidar2img": CameraRig(96, 160).lidar2img[None],
        "can_bus": bus,
        "command": rng.integers(0, 6, 1),
        "timestamp": np.array([time_s], np.float32),
        "prev_bev": memory,
        "prev_memory": rng.uniform(0, 0.3, (1, 2)).astype(np.float32),
    }


@pytest.mark.parametrize("seed", range(3))
def test_onnx_answers_as_torch_does(model: Highway, exported: Path, seed: int) -> None:
    feeds = inputs(np.random.default_rng(seed))
    with torch.no_grad():
        wanted = model(*(torch.from_numpy(x) for x in feeds.values()))
    found = Session(exported, threads=1).run(feeds)
    for name, tensor in zip(HIGHWAY.outputs, wanted, strict=True):
        assert found[name] == pytest.approx(tensor.numpy(), abs=2e-4), name


def test_the_file_is_small_and_standard_and_keeps_the_policy_contract(
    model: Highway, exported: Path
) -> None:
    graph = onnx.load(exported)
    assert [(e.domain, e.version) for e in graph.opset_import] == [("", 17)]
    assert exported.stat().st_size < 20e6
    assert 1e6 < sum(p.numel() for p in model.parameters()) < 3e6
    policy = OnnxPolicy.open(exported)
    assert policy.image_size == (96, 160)
    assert policy.recurrent == {
        "prev_bev": "prev_bev_out",
        "prev_memory": "prev_memory_out",
    }


def test_memory_is_by_time_and_not_by_frames(model: Highway) -> None:
    encoder = model.bev_encoder
    now = torch.randn(1, 64, 32, 24)
    still = motion_of(torch.zeros(1, 18), torch.zeros(1))
    memories = list[torch.Tensor]()
    for count in (4, 8):
        memory = torch.zeros(1, 768, CELL)
        for _ in range(count):
            recalled = encoder.recall(memory, still)
            _, memory = encoder.remember(now, recalled, torch.tensor([0.8 / count]))
        memories.append(memory)
    few, many = (memory[..., :-1] for memory in memories)  # ages are of looks
    assert torch.allclose(few, many, atol=1e-5)


@pytest.mark.parametrize("elapsed_s", [0.3, 0.6])
def test_memory_knows_how_old_it_is(model: Highway, elapsed_s: float) -> None:
    encoder, channels = model.bev_encoder, model.config.channels
    now = torch.randn(1, channels, 32, 24)
    still = motion_of(torch.zeros(1, 18), torch.zeros(1))
    nothing = encoder.recall(torch.zeros(1, 768, CELL), still)
    _, memory = encoder.remember(now, nothing, torch.tensor([0.2]))
    recalled = encoder.recall(memory, still)
    joined, _ = encoder.remember(now, recalled, torch.tensor([elapsed_s]))
    age = joined[:, 2 * channels]
    assert torch.allclose(age, torch.full_like(age, elapsed_s), atol=1e-5)


@pytest.mark.parametrize(
    ("seen", "turned_deg", "moved_m", "found"),
    [
        ((10, 12), 0.0, 4.0, (12, 12)),  # 26 to 28 m ahead, then 4 m nearer
        ((18, 12), 90.0, 0.0, (24, 17)),  # straight ahead, then to the right
    ],
)
def test_memory_follows_the_ground_when_the_ego_moves_or_turns(
    model: Highway,
    seen: tuple[int, int],
    turned_deg: float,
    moved_m: float,
    found: tuple[int, int],
) -> None:
    memory = torch.zeros(1, 32, 24, CELL)
    memory[0, *seen] = 1.0
    bus = torch.zeros(1, 18)
    bus[0, 1], bus[0, 17] = moved_m, turned_deg  # north, where it is heading now
    bus[0, 16] = torch.pi / 2
    motion = motion_of(bus, torch.ones(1))
    recalled = model.bev_encoder.recall(memory.flatten(1, 2), motion)
    assert divmod(int(recalled[0, 0].argmax()), 24) == found


def test_standing_is_remembered_and_fades() -> None:
    once = stood_lately(torch.tensor([0.0, 5.0]), torch.zeros(2), torch.full((2,), 0.1))
    later = stood_lately(torch.full((2,), 5.0), once, torch.full((2,), 5.0))
    assert once.tolist() == [1.0, 0.0]
    assert later.tolist() == pytest.approx([np.exp(-1), 0.0])
