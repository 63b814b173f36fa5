"""Training in several processes that average their gradients; resumes after a kill."""

import json
import math
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
import torch.multiprocessing as mp
from torch import Tensor

from me2e_compress.errors import TrainingError
from me2e_compress.evaluators.highway.cameras import CameraRig
from me2e_compress.zoo.highway.config import HighwayConfig
from me2e_compress.zoo.highway.stack import Highway
from me2e_compress.zoo.train.cache import Cache
from me2e_compress.zoo.train.check import validate
from me2e_compress.zoo.train.data import Episodes, Sequences
from me2e_compress.zoo.train.frenet import anchors_of
from me2e_compress.zoo.train.losses import LampHead
from me2e_compress.zoo.train.parent import end_with_parent
from me2e_compress.zoo.train.step import Augmentation, run, run_planner, total
from me2e_compress.zoo.train.together import Together

CLIP = 5.0
AVERAGED = 0.998
"""Decay of the running mean of the weights, which is what drives."""
WEIGHT_DECAY = 1e-3
WARM_UP = 100
CACHED = 4
"""The planner alone learns from so many times more samples a step."""


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
        check_every: steps between looks at held-out samples.
        modules: which learn; empty: all. The planner alone learns from what the others
            said once.
        sequences: how sequences are drawn.
        augmentation: what is made harder.
    """

    steps: int
    batch: int = 8
    workers: int = 4
    rate: float = 1.5e-3
    seed: int = 0
    save_every: int = 100
    check_every: int = 200
    modules: tuple[str, ...] = ()
    sequences: Sequences = field(default_factory=Sequences)
    augmentation: Augmentation = field(default_factory=Augmentation)


def train(
    what: Training,
    config: HighwayConfig,
    files: Sequence[Path],
    held_out: Sequence[Path],
    start: Path | None,
    folder: Path,
) -> Path:
    """Run a stage, or what is left of it.

    Args:
        what: the stage.
        config: sizes of the model.
        files: episodes to learn from.
        held_out: episodes that are only looked at.
        start: checkpoint to begin with; None begins with random weights.
        folder: gets ``last.pt`` and ``log.jsonl``.

    Returns:
        The checkpoint.

    Raises:
        TrainingError: fewer episodes than processes, or a process died.
    """
    if len(files) < what.workers or not held_out:
        raise TrainingError(
            f"{len(files)} episodes and {len(held_out)} held out are too few for "
            f"{what.workers} processes"
        )
    folder.mkdir(parents=True, exist_ok=True)
    args = (what, config, tuple(files), tuple(held_out), start, folder)
    together = Together.of(what.workers, config)
    try:
        mp.spawn(_process, (args, together), what.workers)
    except mp.ProcessRaisedException as error:
        last = str(error).strip().splitlines()[-1]
        raise TrainingError(f"{folder}: training failed: {last}") from error
    return folder / "last.pt"


def _process(rank: int, args: tuple, together: Together) -> None:  # type: ignore[type-arg]
    end_with_parent()
    torch.set_num_threads(1)
    _Stage(rank, together, *args).run()


class _Stage:
    """What one process holds while it trains."""

    def __init__(
        self,
        rank: int,
        together: Together,
        what: Training,
        config: HighwayConfig,
        files: tuple[Path, ...],
        held_out: tuple[Path, ...],
        start: Path | None,
        folder: Path,
    ) -> None:
        self.rank, self.what, self.folder = rank, what, folder
        self.together = together
        torch.manual_seed(what.seed)
        self.model = Highway(config)
        self.lamps = LampHead(config.channels)
        size = config.image_size
        self.episodes = Episodes(files[rank :: what.workers], size)
        self.held_out = Episodes(held_out, size) if rank == 0 else None
        rig = CameraRig(*config.image_size)
        self.lidar2img = torch.from_numpy(rig.lidar2img)
        self.step, self.begun = 0, time.monotonic()
        self.running: dict[str, float] = {}
        self._begin(start)
        self.model.to(memory_format=torch.channels_last)
        names = what.modules
        for name, child in self.model.named_children():
            child.requires_grad_(not names or name in names)
        everything = [*self.model.parameters(), *self.lamps.parameters()]
        self.learning = [p for p in everything if p.requires_grad]
        self.optimizer = torch.optim.AdamW(
            self.learning, what.rate, weight_decay=WEIGHT_DECAY
        )
        self.mean = {k: v.clone() for k, v in self.model.state_dict().items()}
        self._resume()
        self.cache = None
        if names == ("planner",) and self.step < what.steps:
            self.model.eval()
            self.cache = Cache.of(self.model, self.episodes, self.lidar2img)

    def _begin(self, start: Path | None) -> None:
        if start is not None:
            found = torch.load(start, weights_only=True)
            self.model.load_state_dict(found["mean"])
            self.lamps.load_state_dict(found["lamps"])
            return
        anchors = self.model.planner.anchors
        plans = self.episodes.departures()
        mine = (
            anchors_of(plans, len(anchors)) if self.rank == 0 else 0 * anchors.numpy()
        )
        everybody = self.together.mean(self.rank, torch.from_numpy(mine).flatten())
        anchors.copy_(everybody.view_as(anchors) * self.what.workers)

    def _resume(self) -> None:
        path = self.folder / "last.pt"
        if not path.exists():
            return
        found = torch.load(path, weights_only=True)
        self.model.load_state_dict(found["model"])
        self.lamps.load_state_dict(found["lamps"])
        self.optimizer.load_state_dict(found["optimizer"])
        self.mean, self.step = found["mean"], int(found["step"])

    def run(self) -> None:
        """Train to the end."""
        while self.step < self.what.steps:
            self._rate()
            self._learn()
            self.step += 1
            last = self.step == self.what.steps
            if self.step % self.what.check_every == 0 or last:
                self._check()
            if self.step % self.what.save_every == 0 or last:
                self._save()

    def _rate(self) -> None:
        warm = min(1.0, (self.step + 1) / WARM_UP)
        cosine = 0.5 * (1 + math.cos(math.pi * self.step / self.what.steps))
        for group in self.optimizer.param_groups:
            group["lr"] = self.what.rate * warm * (cosine + 0.01)

    def _learn(self) -> None:
        rng = np.random.default_rng([self.what.seed, self.step, self.rank])
        torch.manual_seed(int(rng.integers(2**31)))
        losses = self._planner(rng) if self.cache else self._everything(rng)
        self.optimizer.zero_grad()
        total(losses).backward()
        self._average_gradients()
        torch.nn.utils.clip_grad_norm_(self.learning, CLIP)
        self.optimizer.step()
        self._note(losses)
        if self.rank == 0:
            self._follow()

    def _everything(self, rng: np.random.Generator) -> dict[str, Tensor]:
        """Losses of all modules on sequences."""
        picked = self.episodes.draw(rng, self.what.batch, self.what.sequences)
        images = self.episodes.images(picked.ravel())
        images = images.reshape(*picked.shape, *images.shape[1:])
        batch = self.episodes.batch(picked)
        how = self.what.augmentation
        self.model.train()
        outcome = run(self.model, self.lamps, images, batch, self.lidar2img, rng, how)
        return outcome.losses

    def _planner(self, rng: np.random.Generator) -> dict[str, Tensor]:
        """Losses of the planner on what the frozen modules once said."""
        count = self.what.batch * self.what.sequences.length * CACHED
        picked = self.episodes.draw(rng, count, Sequences(length=1))[:, 0]
        batch = self.episodes.rows(picked)
        self.model.eval().planner.train()
        world = self.cache.world(picked)
        return run_planner(self.model, world, batch, rng, self.what.augmentation)

    def _average_gradients(self) -> None:
        grads = [
            p.grad if p.grad is not None else torch.zeros_like(p) for p in self.learning
        ]
        flat = self.together.mean(self.rank, torch.cat([g.flatten() for g in grads]))
        for p, part in zip(
            self.learning, flat.split([p.numel() for p in self.learning]), strict=True
        ):
            p.grad = part.view_as(p)

    def _follow(self) -> None:
        """Move the running mean of the weights."""
        decay = min(AVERAGED, (self.step + 1) / (self.step + 10))
        for name, value in self.model.state_dict().items():
            if value.is_floating_point():
                self.mean[name].lerp_(value, 1 - decay)
            else:
                self.mean[name].copy_(value)

    def _note(self, losses: Mapping[str, Tensor]) -> None:
        for name, loss in losses.items():
            value = float(loss.detach())
            old = self.running.get(name, value)
            self.running[name] = 0.97 * old + 0.03 * value

    def _check(self) -> None:
        """Look at held-out samples with the averaged weights; log."""
        if self.held_out is None:
            return
        mine = {k: v.clone() for k, v in self.model.state_dict().items()}
        self.model.load_state_dict(self.mean)
        self.model.eval()
        found = validate(self.model, self.lamps, self.held_out, self.lidar2img)
        self.model.load_state_dict(mine)
        row = {
            "step": self.step,
            "seconds": round(time.monotonic() - self.begun, 1),
            "held_out": found,
            "training": {k: round(v, 4) for k, v in self.running.items()},
        }
        with (self.folder / "log.jsonl").open("a") as log:
            log.write(json.dumps(row) + "\n")

    def _save(self) -> None:
        if self.rank == 0:
            draft = self.folder / ".last.pt"
            torch.save(
                {
                    "model": self.model.state_dict(),
                    "mean": self.mean,
                    "lamps": self.lamps.state_dict(),
                    "optimizer": self.optimizer.state_dict(),
                    "step": self.step,
                    "what": json.dumps(asdict(self.what)),
                },
                draft,
            )
            os.replace(draft, self.folder / "last.pt")
