"""The heads of UniAD on a reduced configuration: shapes, and what reads what."""

import pytest
import torch

from models.tests.uniad.small import SMALL, small_uniad
from models.uniad.motion import Agents, Forecasts, ModeIntent
from models.uniad.occ import OccHead
from models.uniad.stack import UniadTiny

pytestmark = pytest.mark.xdist_group("uniad")

CELLS = 24 * 24
AGENTS = 4


@pytest.fixture(scope="module")
def uniad() -> UniadTiny:
    return small_uniad()


def noise(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(len(shape)))


def test_levels_of_the_neck_are_those_of_the_configuration(uniad: UniadTiny) -> None:
    stages = uniad.img_backbone(noise(6, 3, *SMALL.image_hw))
    levels = uniad.img_neck(stages)
    assert tuple(tuple(level.shape[2:]) for level in levels) == SMALL.hws


def test_map_gives_queries_boxes_and_masks(uniad: UniadTiny) -> None:
    found = [tuple(x.shape) for x in uniad.seg_head(noise(1, CELLS, 256))]
    assert found == [(1, 5, 256), (1, 5, 256), (1, 5, 6), (1, 5, 4), (1, 5, 24, 24)]


def test_plans_differ_by_command(uniad: UniadTiny) -> None:
    bev = noise(1, CELLS, 256)
    seen = noise(1, 6, 256), noise(1, 256)
    plans = [
        uniad.planning_head(*seen, torch.tensor([command]), bev, bev)
        for command in (0, 3)
    ]
    assert tuple(plans[0].shape) == (1, 6, 2)
    assert not torch.equal(plans[0], plans[1])


def occupancy(head: OccHead, empty: list[bool], labels: list[int]) -> torch.Tensor:
    """Of four tracks of score 1, whose queries are the same whatever is asked."""
    query = noise(1, AGENTS + 1, 256)
    nothing = torch.zeros(1)
    agents = Agents(
        query,
        torch.zeros(AGENTS + 1, 10),
        torch.tensor([*labels, 0]),
        torch.tensor([[*empty, False]]),
    )
    motion = Forecasts(nothing, nothing, noise(1, AGENTS + 1, 6, 256), query)
    out: torch.Tensor = head(noise(1, CELLS, 256), agents, motion, torch.ones(AGENTS))
    return out


def test_occupancy_is_a_probability_for_step_and_cell(uniad: UniadTiny) -> None:
    taken = occupancy(uniad.occ_head, [False] * AGENTS, [0] * AGENTS)
    assert tuple(taken.shape) == (1, 5, 24, 24)
    assert 0 <= taken.min() < taken.max() <= 1


@pytest.mark.parametrize(
    ("empty", "labels"),
    [([True] * AGENTS, [0] * AGENTS), ([False] * AGENTS, [5, 8] * 2)],
)
def test_who_is_not_seen_and_who_is_no_vehicle_takes_no_ground(
    uniad: UniadTiny, empty: list[bool], labels: list[int]
) -> None:
    assert not occupancy(uniad.occ_head, empty, labels).any()


def test_tracks_without_memory_stay_as_they_are(uniad: UniadTiny) -> None:
    tracks, bank = noise(AGENTS, 256), noise(AGENTS, 4, 256)
    due = torch.zeros(AGENTS, dtype=torch.bool)
    same, _, _ = uniad.memory_bank(tracks, bank, torch.zeros(AGENTS, 4), due)
    assert torch.equal(same, tracks)


def test_what_is_due_is_remembered_as_the_newest(uniad: UniadTiny) -> None:
    tracks, bank = noise(AGENTS, 256), noise(AGENTS, 4, 256)
    due = torch.tensor([True, False, False, False])
    _, kept, held = uniad.memory_bank(tracks, bank, torch.zeros(AGENTS, 4), due)
    assert torch.equal(kept[1:], bank[1:])
    assert held.tolist() == [[0, 0, 0, 1], [0] * 4, [0] * 4, [0] * 4]


def test_an_empty_slot_changes_no_agent(uniad: UniadTiny) -> None:
    former, lanes = uniad.motion_head.motionformer, noise(1, 5, 256)
    query, at = noise(AGENTS, 6, 256), noise(AGENTS, 6, 12, 2)
    intent = ModeIntent(query, (query, query, query))
    empty = torch.tensor([[False, False, False, True]])
    track, pos, bev = noise(1, AGENTS, 256), noise(1, AGENTS, 256), noise(1, CELLS, 256)
    other = track.clone()
    other[:, 3] += 1
    one = former(0, query, intent, (track, pos, empty), lanes, bev, at)
    two = former(0, query, intent, (other, pos, empty), lanes, bev, at)
    torch.testing.assert_close(one[:3], two[:3])
