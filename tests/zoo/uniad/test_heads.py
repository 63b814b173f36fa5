"""The heads of UniAD on a reduced configuration: shapes, and what reads what."""

import pytest
import torch

from me2e_compress.zoo.bev.sizes import BevGrid
from me2e_compress.zoo.uniad.config import UniadConfig
from me2e_compress.zoo.uniad.stack import UniadTiny

SMALL = UniadConfig(
    image_hw=(64, 96),
    stem=8,
    grid=BevGrid((8, 8), (-51.2, -51.2, -5.0, 51.2, 51.2, 3.0), (8.0, 8.0)),
    queries=9,
    tracks=4,
    encoder_layers=1,
    decoder_layers=2,
    map_queries=5,
)
CELLS = 16 * 16
AGENTS = 4


@pytest.fixture(scope="module")
def uniad() -> UniadTiny:
    generator = torch.Generator().manual_seed(0)
    model = UniadTiny(SMALL).requires_grad_(False).eval()
    for parameter in model.parameters():
        parameter.normal_(0, 0.05, generator=generator)
    return model


def noise(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(len(shape)))


def test_levels_of_the_neck_are_those_of_the_configuration(uniad: UniadTiny) -> None:
    stages = uniad.img_backbone.stages(noise(6, 3, *SMALL.image_hw))[1:]
    levels = uniad.img_neck(stages)
    assert tuple(tuple(level.shape[2:]) for level in levels) == SMALL.hws


def test_map_gives_queries_boxes_and_masks(uniad: UniadTiny) -> None:
    bev, pos = noise(1, CELLS, 256), noise(1, CELLS, 256)
    found = [tuple(x.shape) for x in uniad.seg_head(bev, pos)]
    assert found == [(1, 5, 256), (1, 5, 256), (1, 5, 6), (1, 5, 4), (1, 5, CELLS)]


def test_plans_differ_by_command(uniad: UniadTiny) -> None:
    bev = noise(1, CELLS, 256)
    seen = noise(1, 6, 256), noise(1, 256)
    plans = [
        uniad.planning_head(*seen, torch.tensor([command]), bev, bev)
        for command in (0, 3)
    ]
    assert tuple(plans[0].shape) == (1, 6, 2)
    assert not torch.equal(plans[0], plans[1])


def test_occupancy_is_a_logit_for_agent_step_and_cell(uniad: UniadTiny) -> None:
    agents = noise(1, AGENTS, 256)
    bev = noise(1, 256, 16, 16)
    logits = uniad.occ_head(bev, noise(1, AGENTS, 6, 256), agents, agents)
    assert tuple(logits.shape) == (1, AGENTS, 5, 16, 16)


def test_tracks_without_memory_stay_as_they_are(uniad: UniadTiny) -> None:
    tracks, bank = noise(AGENTS, 256), noise(AGENTS, 4, 256)
    empty = torch.ones(AGENTS, 4, dtype=torch.bool)
    assert torch.equal(uniad.memory_bank(tracks, bank, empty), tracks)


def test_what_is_due_is_remembered_as_the_newest(uniad: UniadTiny) -> None:
    tracks, bank = noise(AGENTS, 256), noise(AGENTS, 4, 256)
    empty = torch.ones(AGENTS, 4, dtype=torch.bool)
    due = torch.tensor([[True], [False], [False], [False]])
    kept, left = uniad.memory_bank.save(tracks, bank, empty, due)
    assert torch.equal(kept[1:], bank[1:])
    assert left[:, -1].tolist() == [False, True, True, True]


def test_an_empty_slot_changes_no_agent(uniad: UniadTiny) -> None:
    former, lanes = uniad.motion_head.motionformer, (noise(1, 5, 256),) * 2
    query, at = noise(AGENTS, 6, 256), noise(AGENTS, 6, 12, 2)
    empty = torch.tensor([[False, False, False, True]])
    track, pos, bev = noise(1, AGENTS, 256), noise(1, AGENTS, 256), noise(1, CELLS, 256)
    other = track.clone()
    other[:, 3] += 1
    one = former.mix(0, query, (track, pos, empty), lanes, bev, at)
    two = former.mix(0, query, (other, pos, empty), lanes, bev, at)
    torch.testing.assert_close(one[:3], two[:3])
