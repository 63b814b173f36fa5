"""Processes that average."""

import threading

import pytest
import torch
import torch.multiprocessing as mp
from torch.multiprocessing.spawn import spawn

from models.driver.losses import LampHead
from models.driver.network.stack import Highway
from models.driver.process_group import ProcessGroup
from models.tests.driver.made import LITTLE

pytestmark = pytest.mark.xdist_group("process-group")


def average(rank: int, group: ProcessGroup, answers: torch.Tensor) -> None:
    """Twice, so that the second must not meet what the first left behind."""
    for turn in range(2):
        mine = torch.arange(5.0) * (rank + 1) + 100 * turn
        answers[rank, turn] = group.average(rank, mine)
    if rank == 0:
        group.report(2)


@pytest.fixture(scope="module")
def group() -> ProcessGroup:
    return ProcessGroup.of(2, LITTLE)


@pytest.fixture(scope="module")
def answers(group: ProcessGroup) -> torch.Tensor:
    answers: torch.Tensor = torch.full((2, 2, 5), torch.nan).share_memory_()
    spawn(average, (group, answers), 2)
    return answers


def test_every_process_gets_the_mean(answers: torch.Tensor) -> None:
    first = torch.arange(5.0) * 1.5
    wanted = torch.stack([first, first + 100])
    assert torch.equal(answers, wanted.expand(2, 2, 5))


@pytest.mark.usefixtures("answers")
def test_who_waits_is_told_how_far_they_are(group: ProcessGroup) -> None:
    assert group.steps_done() == 2


def test_there_is_room_for_all_that_learns(group: ProcessGroup) -> None:
    modules = (Highway(LITTLE), LampHead(LITTLE.channels))
    numbers = sum(p.numel() for module in modules for p in module.parameters())
    assert group.rows.shape == (2, numbers)


def test_who_waits_in_vain_gives_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("models.driver.process_group.PATIENCE_S", 0.1)
    alone = ProcessGroup(
        torch.zeros(2, 5),
        mp.get_context("spawn").Barrier(2),
        torch.zeros(1, dtype=torch.int64),
    )
    with pytest.raises(threading.BrokenBarrierError):
        alone.average(0, torch.zeros(5))
