"""One training step: sequences in, losses out."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from models.driver.label_tensors import Labels, labels_of
from models.driver.losses import (
    LampHead,
    map_losses,
    motion_losses,
    occ_losses,
    plan_losses,
    track_losses,
)
from models.driver.losses.detection_losses import match
from models.driver.network.bev_encoder import RECORD, motion_of
from models.driver.network.interfaces import Candidates, EgoState, PlannerInput
from models.driver.network.stack import STOOD_S, Highway, ModuleOutputs
from models.driver.stored_episode import Array

MEAN, STD = 110.0, 60.0
"""Grey levels: about the mean and spread of the rendered images."""

WEIGHTS = {
    "heat": 0.3,
    "score": 1.0,
    "box": 0.5,
    "class": 0.3,
    "travel": 0.6,
    "mode": 0.2,
    "path": 0.5,
    "heading": 2.0,
    "attributes": 0.3,
    "raster": 1.0,
    "signal": 1.0,
    "line": 0.5,
    "colour": 0.5,
    "lamp": 0.2,
    "occ": 2.0,
    "choice": 1.0,
    "bend": 1.0,
    "place": 0.5,
    "safe": 3.0,
}
"""Of the losses in their sum: each contributes between 0.1 and 1 after a while."""


@dataclass(frozen=True)
class Augmentation:
    """Augmentation of the training samples.

    Attributes:
        light: spread of brightness and contrast.
        speed_mps: noise of the measured speed.
        forget: share of samples that lose the memory of standing.
        hints: share of samples whose agents are certain to be among the queries.
        no_occ: share that plan on the mean occupancy, so that boxes are used too.
        overlooked: share of agents that boxes and futures do not show to the planner,
            so that occupancy is used too: see `without_rivals`.
    """

    light: float = 0.12
    speed_mps: float = 0.1
    forget: float = 0.1
    hints: float = 0.7
    no_occ: float = 0.2
    overlooked: float = 0.0


NO_AUGMENTATION = Augmentation(0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass
class StepOutcome:
    """The outcome of a batch.

    Attributes:
        losses: by name, not weighted.
        seen: outputs of the modules.
        world: inputs of the planner.
        candidates: of the planner.
        wanted: the labels.
    """

    losses: dict[str, Tensor]
    seen: ModuleOutputs
    world: PlannerInput
    candidates: Candidates
    wanted: Labels


def run_planner(
    model: Highway,
    world: PlannerInput,
    batch: dict[str, Array],
    rng: np.random.Generator,
    how: Augmentation,
) -> dict[str, Tensor]:
    """Run the planner alone on cached outputs of the other modules; return its losses.

    Args:
        model: the stack.
        world: of B samples.
        batch: arrays [B, ...].
        rng: of the augmentation.
        how: the augmentation.
    """
    wanted = labels_of(batch, model.config.area)
    with torch.autocast("cpu", torch.bfloat16):
        ego = _ego(batch, rng, how)
        damaged = without_rivals(world, rng, how)
        candidates = model.planner.consider(damaged, ego, wanted.command)
    return plan_losses(candidates, wanted, model.config.area)


def total(losses: Mapping[str, Tensor]) -> Tensor:
    """Return the weighted sum of losses."""
    return torch.stack([WEIGHTS[name] * loss for name, loss in losses.items()]).sum()


def run(
    model: Highway,
    lamps: LampHead,
    images: Array,
    batch: dict[str, Array],
    lidar2img: Tensor,
    rng: np.random.Generator,
    how: Augmentation,
) -> StepOutcome:
    """Run sequences through the model.

    Args:
        model: the stack.
        lamps: the extra head.
        images: uint8 [B, L, 6, H, W, 3].
        batch: arrays [B, L, ...] of `Episodes.batch`.
        lidar2img: [6, 4, 4].
        rng: of the augmentation.
        how: the augmentation.
    """
    flat = {name: rows.reshape(-1, *rows.shape[2:]) for name, rows in batch.items()}
    wanted = labels_of(flat, model.config.area)
    count = len(wanted.command)
    calibration = lidar2img.expand(count, -1, -1, -1)
    with torch.autocast("cpu", torch.bfloat16):
        # cameras to bird's-eye view, the memory fed forward through each sequence
        fine, middle = model.look(pixels_of(images, rng, how))
        now = model.bev_encoder.look(fine, calibration)
        bev = model.bev_encoder.fuse(remember(model, now.float(), batch))
        # the task modules, on all frames at once
        hints = _hints(wanted, model.config.area.cells, rng, how)
        seen = model.understand(bev, model.bev_encoder.tokens(bev), middle, hints)
        # the planner, on augmented inputs
        world = model.world(seen, wanted.command)
        world = without_rivals(world, rng, how)
        ego = _ego(flat, rng, how)
        candidates = model.planner.consider(_settled(world), ego, wanted.command)
        lamp_loss = lamps(fine, calibration, wanted)
    owner, mine = match(seen.tracks, wanted)
    losses = {
        **track_losses(seen.tracks, wanted, model.config.area, owner, mine),
        **motion_losses(seen.futures, wanted, owner, mine),
        **map_losses(seen.road, wanted),
        **lamp_loss,
        **occ_losses(seen.occupancy, wanted),
        **plan_losses(candidates, wanted, model.config.area),
    }
    return StepOutcome(losses, seen, world, candidates, wanted)


def _settled(world: PlannerInput) -> PlannerInput:
    """Detach the map from the planner's loss: it refines plans, not the map."""
    return replace(
        world,
        lateral=world.lateral.detach(),
        path=world.path.detach(),
        headings=world.headings.detach(),
    )


def pixels_of(images: Array, rng: np.random.Generator, how: Augmentation) -> Tensor:
    """Convert uint8 [B, L, 6, H, W, 3] to the model's input [B * L, 6, 3, H, W]."""
    count = images.shape[0] * images.shape[1]
    pixels = torch.from_numpy(images).flatten(0, 1).permute(0, 1, 4, 2, 3)
    spread = rng.normal(0, how.light, (2, count, 6, 1, 1, 1))
    gain = torch.from_numpy((1 + spread[0]) / STD).float()
    bias = torch.from_numpy(spread[1]).float() - MEAN * gain
    return torch.addcmul(bias, pixels.float(), gain)


def remember(model: Highway, now: Tensor, batch: dict[str, Array]) -> Tensor:
    """Feed the memory forward: [B * L, C, ...] to [B * L, 2 C + 2, ...]."""
    encoder = model.bev_encoder
    times = torch.from_numpy(batch["time_us"].astype(np.float64) / 1e6).float()
    buses = torch.from_numpy(batch["can_bus"].astype(np.float32))
    sequences, length = times.shape
    looks = now.unflatten(0, (sequences, length))
    memory = torch.zeros(sequences, encoder.area.cells, now.shape[1] + RECORD)
    joined = []
    for t in range(length):
        elapsed = (
            times[:, t] - times[:, t - 1] if t else torch.full_like(times[:, 0], 0.2)
        )
        recalled = encoder.recall(memory, motion_of(buses[:, t], elapsed))
        both, memory = encoder.remember(looks[:, t], recalled, elapsed)
        joined.append(both)
    return torch.stack(joined, 1).flatten(0, 1)


def _hints(
    wanted: Labels, cells: int, rng: np.random.Generator, how: Augmentation
) -> Tensor | None:
    if not how.hints:
        return None
    told = torch.from_numpy(rng.random(len(wanted.there)) < how.hints)
    hints = torch.zeros(len(wanted.there), cells)
    return hints.scatter_add(1, wanted.cells, (wanted.there & told[:, None]).float())


def _ego(flat: dict[str, Array], rng: np.random.Generator, how: Augmentation) -> Tensor:
    bus = torch.from_numpy(flat["can_bus"].astype(np.float32)).clone()
    stood = torch.exp(torch.from_numpy(flat["rest_s"].astype(np.float32)) / -STOOD_S)
    count = len(bus)
    bus[:, 7] += torch.from_numpy(rng.normal(0, 1, count)).float() * how.speed_mps
    stood[torch.from_numpy(rng.random(count) < how.forget)] = 0
    return EgoState(bus, stood).features()


def without_rivals(
    world: PlannerInput, rng: np.random.Generator, how: Augmentation
) -> PlannerInput:
    """Take from the planner what tells it the same as another module.

    Boxes with futures and occupancy both tell where others will be. A network leans on
    what it learns from first, and leaves the other unused (Wu et al., ICML 2022).
    Dropping an input (ModDrop, Neverova et al., 2016) teaches to do without it; what
    makes it matter is dropping its rival, so that nothing else gives the answer.
    Agents go one by one, as if overlooked: were all of a sample gone, the planner could
    learn to read occupancy then only. An agent of score 0 is in no cost and no token.
    """
    gone = torch.from_numpy(rng.random(len(world.occupancy)) < how.no_occ)
    mean = world.occupancy.mean(0, keepdim=True)
    kept = torch.where(gone[:, None, None, None], mean, world.occupancy)
    if not how.overlooked:
        return replace(world, occupancy=kept)
    shown = torch.from_numpy(rng.random(world.score.shape) >= how.overlooked)
    # without occupancy every agent is shown: something must tell where the others are
    score = world.score * (shown | gone[:, None])
    return replace(world, occupancy=kept, score=score)
