"""One process of training."""

import json
import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from me2e_compress.simulator.camera_rig import CameraRig
from models.driver.checkpoint import Start, TrainingCheckpoint, fit
from models.driver.data import Episodes, Sequences
from models.driver.frenet import anchors_of
from models.driver.log import Log
from models.driver.losses import LampHead
from models.driver.network.config import HighwayConfig
from models.driver.network.stack import Highway
from models.driver.optimizer import AveragedAdamW, WeightAverage
from models.driver.process_group import ProcessGroup
from models.driver.sampled_losses import SampledLosses
from models.driver.step import Augmentation, total
from models.driver.validation import validate

CHECKPOINT, LOG = "last.pt", "log.jsonl"
INPUTS = "planner-inputs"
"""Folder of what the planner alone learns from, while it learns."""
WARM_UP = 100
"""Steps in which the learning rate grows."""
LAST_SHARE = 0.01
"""Of the highest learning rate, when the cosine has come to its end."""
SMOOTH = 0.97
"""Decay of the running losses in the log: they look back over about 30 steps."""
PLANNER_ALONE = ("planner",)


@dataclass(frozen=True)
class Training:
    """One stage of training.

    Attributes:
        steps: optimizer steps.
        batch: sequences a step and process.
        workers: processes.
        rate: highest learning rate.
        seed: of everything random.
        save_every: steps between checkpoints.
        check_every: steps between validations on held-out samples.
        check_count: sequences of a validation.
        modules: which learn; empty: all. The planner alone learns from cached outputs
            of the others.
        sequences: how sequences are drawn.
        augmentation: of the samples.
    """

    steps: int
    batch: int = 6
    workers: int = 4
    rate: float = 1.5e-3
    seed: int = 0
    save_every: int = 25
    check_every: int = 200
    check_count: int = 240
    modules: tuple[str, ...] = ()
    sequences: Sequences = field(default_factory=Sequences)
    augmentation: Augmentation = field(default_factory=Augmentation)


@dataclass(frozen=True)
class StageTask:
    """A stage and its files.

    Attributes:
        what: the stage.
        config: sizes of the model.
        files: episodes to learn from.
        held_out: episodes for validation only.
        start: checkpoint to start from, or its `Start` alone; None starts with random
            weights.
        folder: gets ``last.pt`` and ``log.jsonl``.
    """

    what: Training
    config: HighwayConfig
    files: tuple[Path, ...]
    held_out: tuple[Path, ...]
    start: Path | None
    folder: Path


class TrainingProcess:
    """One of the processes that train a stage together."""

    def __init__(self, rank: int, group: ProcessGroup, task: StageTask) -> None:
        """Read the episodes and begin, or go on where the checkpoint is.

        Args:
            rank: of this process; the first one checks, saves and logs.
            group: all processes.
            task: the same in every process.

        Raises:
            TrainingError: a file is not what it should be.
        """
        self.rank, self.group, self.task = rank, group, task
        what, size = task.what, task.config.image_size
        torch.manual_seed(what.seed)
        self.model, self.lamps = Highway(task.config), LampHead(task.config.channels)
        mine = set(list(dict.fromkeys(task.files))[rank :: what.workers])
        episodes = Episodes([file for file in task.files if file in mine], size)
        self.held_out = Episodes(task.held_out, size) if rank == 0 else None
        self.lidar2img = torch.from_numpy(CameraRig(*size).lidar2img)
        self.sampled = SampledLosses(
            episodes, self.lidar2img, what.batch, what.sequences, what.augmentation
        )
        self._begin(episodes)
        # torch's stubs leave this form of `to` out
        self.model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.optimizer = AveragedAdamW(self._learning(), what.rate, group)
        self.average, self.step = WeightAverage(self.model), 0
        self.log, self.running = Log(task.folder / LOG), dict[str, float]()
        self._resume()
        if what.modules == PLANNER_ALONE and self.step < what.steps:
            self.sampled.freeze(self.model, task.folder / INPUTS)
        self.begun = time.monotonic() - self._spent_s()

    def _begin(self, episodes: Episodes) -> None:
        if self.task.start is not None:
            found = Start.load(self.task.start)
            fit(self.model, found.mean, self.task.start)
            fit(self.lamps, found.lamps, self.task.start)
            return
        anchors = self.model.planner.anchors
        mine = torch.zeros_like(anchors)
        if self.rank == 0:
            mine = torch.from_numpy(anchors_of(episodes.departures(), len(anchors)))
        average = self.group.average(self.rank, mine.flatten())
        # only the first process has anchors: the sum, not the mean
        anchors.copy_(average.view_as(anchors) * self.task.what.workers)

    def _learning(self) -> list[torch.nn.Parameter]:
        names = self.task.what.modules
        for name, child in self.model.named_children():
            child.requires_grad_(not names or name in names)
        everything = [*self.model.parameters(), *self.lamps.parameters()]
        return [p for p in everything if p.requires_grad]

    def _resume(self) -> None:
        path = self.task.folder / CHECKPOINT
        if path.exists():
            found = TrainingCheckpoint.load(path)
            fit(self.model, found.mean, path)
            fit(self.model, found.model, path)
            fit(self.lamps, found.lamps, path)
            self.optimizer.adamw.load_state_dict(found.optimizer)
            self.average.weights, self.step = dict(found.mean), found.step
        if self.rank == 0:
            self.log.rewind(self.step)

    def _spent_s(self) -> float:
        """Return the seconds spent before, by the log."""
        rows = self.log.rows() if self.rank == 0 else []
        return max((row.get("seconds", 0.0) for row in rows), default=0.0)

    def run(self) -> None:
        """Train to the end."""
        what = self.task.what
        while self.step < what.steps:
            # losses of drawn samples, averaged gradients, a step, the running mean
            rng = np.random.default_rng([what.seed, self.step, self.rank])
            losses = self.sampled.draw(self.model, self.lamps, rng)
            self.optimizer.step(total(losses), rate_at(what, self.step), self.rank)
            self._note(losses)
            if self.rank == 0:
                self.average.update(self.model, self.step)
            self.step += 1
            # validation, checkpoint and progress
            last = self.step == what.steps
            if self.step % what.check_every == 0 or last:
                self._check()
            if self.step % what.save_every == 0 or last:
                self._save()
            if self.rank == 0:
                self.group.report(self.step)

    def _note(self, losses: Mapping[str, Tensor]) -> None:
        for name, loss in losses.items():
            value = float(loss.detach())
            old = self.running.get(name, value)
            self.running[name] = SMOOTH * old + (1 - SMOOTH) * value

    def _check(self) -> None:
        """Validate the averaged weights on held-out samples, and log it."""
        if self.held_out is None:
            return
        mine = {k: v.clone() for k, v in self.model.state_dict().items()}
        self.model.load_state_dict(self.average.weights)
        self.model.eval()
        count = self.task.what.check_count
        found = validate(
            self.model, self.lamps, self.held_out, self.lidar2img, count, min(count, 10)
        )
        self.model.load_state_dict(mine)
        row = {
            "seconds": round(time.monotonic() - self.begun, 1),
            "held_out": found,
            "training": {k: round(v, 4) for k, v in self.running.items()},
        }
        self.log.add("losses", self.step, row)

    def _save(self) -> None:
        if self.rank == 0:
            TrainingCheckpoint(
                self.model.state_dict(),
                self.average.weights,
                self.lamps.state_dict(),
                self.optimizer.adamw.state_dict(),
                self.step,
                json.dumps(asdict(self.task.what)),
            ).save(self.task.folder / CHECKPOINT)


def rate_at(what: Training, step: int) -> float:
    """Return the learning rate of a step: linear warm-up, then a cosine."""
    warm = min(1.0, (step + 1) / WARM_UP)
    cosine = 0.5 * (1 + math.cos(math.pi * step / what.steps))
    return what.rate * warm * (cosine + LAST_SHARE)
