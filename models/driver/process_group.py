"""Processes on one machine that average tensors through shared memory."""

from dataclasses import dataclass
from multiprocessing.synchronize import Barrier
from typing import Self

import torch
from torch import Tensor

from me2e_compress.runtime.children import spawn_context
from models.driver.losses import LampHead
from models.driver.network.config import HighwayConfig
from models.driver.network.stack import Highway

PATIENCE_S = 3600.0
"""A process that keeps the others waiting longer hangs; one that dies ends them all.
Before its first step the planner's inputs take each its time on a busy machine."""


@dataclass
class ProcessGroup:
    """One row of shared memory a process, a barrier, and how far they are.

    Loopback sockets, which torch.distributed would use, cost more than the step on
    machines that emulate them.

    Attributes:
        rows: float32 [processes, numbers].
        barrier: all processes meet here.
        steps: int64 [1], as the first process reported.
    """

    rows: Tensor
    barrier: Barrier
    steps: Tensor

    @classmethod
    def of(cls, workers: int, config: HighwayConfig) -> Self:
        """Make room for every parameter of the model and of the extra head."""
        modules = (Highway(config), LampHead(config.channels))
        size = sum(p.numel() for module in modules for p in module.parameters())
        rows = torch.zeros(workers, size).share_memory_()
        steps = torch.zeros(1, dtype=torch.int64).share_memory_()
        return cls(rows, spawn_context().Barrier(workers), steps)

    def average(self, rank: int, mine: Tensor) -> Tensor:
        """Average one flat tensor over the processes; every process must call it."""
        count = mine.numel()
        self.rows[rank, :count] = mine
        self.barrier.wait(PATIENCE_S)
        found = self.rows[:, :count].mean(0)
        self.barrier.wait(PATIENCE_S)
        return found

    def report(self, step: int) -> None:
        """Report to the parent process how many steps are done."""
        self.steps[0] = step

    def steps_done(self) -> int:
        """Return how many steps are done."""
        return int(self.steps[0])
