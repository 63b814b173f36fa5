"""One training step on a small batch."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from me2e_compress.simulator.camera_rig import CameraRig
from models.driver.data import Episodes, Sequences
from models.driver.losses import LampHead
from models.driver.network.bev_encoder import RECORD
from models.driver.network.interfaces import PlannerInput
from models.driver.network.stack import Highway
from models.driver.sampled_losses import PlannerInputCache
from models.driver.step import (
    MEAN,
    NO_AUGMENTATION,
    STD,
    WEIGHTS,
    Augmentation,
    StepOutcome,
    pixels_of,
    remember,
    run,
    run_planner,
    total,
    without_rivals,
)
from models.stacks import HIGHWAY
from models.tests.driver.made import LITTLE, SIZE, arrays_of, write

PLAN = ("choice", "bend", "place", "safe")
LIDAR2IMG = torch.from_numpy(CameraRig(*SIZE).lidar2img)


@pytest.fixture(scope="module")
def episodes(tmp_path_factory: pytest.TempPathFactory) -> Episodes:
    folder = tmp_path_factory.mktemp("episodes")
    return Episodes([write(folder / "a.npz", arrays_of(6))], SIZE)


@pytest.fixture(scope="module")
def model() -> Highway:
    torch.manual_seed(0)
    model = Highway(LITTLE)
    spread = torch.linspace(-4, 4, LITTLE.anchors)[:, None]
    model.planner.anchors[..., 0] = spread
    return model


@pytest.fixture(scope="module")
def lamps() -> LampHead:
    torch.manual_seed(1)
    return LampHead(LITTLE.channels)


def outcome(
    model: Highway, lamps: LampHead, episodes: Episodes, how: Augmentation, seed: int
) -> StepOutcome:
    rng = np.random.default_rng(seed)
    picked = episodes.draw(rng, 2, Sequences(2))
    images = episodes.images(picked.ravel()).reshape(2, 2, 6, *SIZE, 3)
    batch = episodes.batch(picked)
    return run(model.train(), lamps, images, batch, LIDAR2IMG, rng, how)


def gradients(module: nn.Module) -> float:
    return sum(
        float(p.grad.abs().sum()) for p in module.parameters() if p.grad is not None
    )


@pytest.fixture(scope="module")
def stepped(model: Highway, lamps: LampHead, episodes: Episodes) -> StepOutcome:
    found = outcome(model, lamps, episodes, Augmentation(), 0)
    model.zero_grad()
    lamps.zero_grad()
    total(found.losses).backward()
    return found


def test_all_losses_are_there_and_finite(stepped: StepOutcome) -> None:
    assert set(stepped.losses) == set(WEIGHTS)
    assert all(torch.isfinite(loss) for loss in stepped.losses.values())


def test_every_module_learns(
    stepped: StepOutcome, model: Highway, lamps: LampHead
) -> None:
    parts = {**dict(model.named_children()), "lamps": lamps}
    modules = {name: part for name, part in parts.items() if list(part.parameters())}
    assert min(gradients(each) for each in modules.values()) > 0, modules.keys()


def test_only_what_cannot_learn_is_idle(stepped: StepOutcome, model: Highway) -> None:
    idle = {name for name, p in model.named_parameters() if p.grad is None}
    # layers without self-attention have the LayerNorm before it all the same
    unused = ("road_layer.norms.0", "grid_layer.norms.0")
    assert idle == {
        f"planner.{name}.{kind}" for name in unused for kind in ("weight", "bias")
    }


@pytest.mark.parametrize(
    ("module", "learns"),
    [
        ("planner", True),
        ("motion", True),
        ("track", True),
        ("backbone", True),
        ("map.rough", False),
        ("map.fine", False),
        ("map.raster", False),
        ("map.signal", False),
    ],
)
def test_the_plan_does_not_bend_the_map(
    model: Highway, lamps: LampHead, episodes: Episodes, module: str, learns: bool
) -> None:
    found = outcome(model, lamps, episodes, NO_AUGMENTATION, 1)
    model.zero_grad()
    total({name: found.losses[name] for name in PLAN}).backward()
    assert (gradients(model.get_submodule(module)) > 0) is learns


def test_the_same_seed_gives_the_same_losses(
    model: Highway, lamps: LampHead, episodes: Episodes
) -> None:
    found = [outcome(model, lamps, episodes, Augmentation(), 3) for _ in range(2)]
    numbers = [{k: float(v.detach()) for k, v in one.losses.items()} for one in found]
    assert numbers[0] == numbers[1]


def test_without_augmentation_pixels_are_those_of_the_contract() -> None:
    images = np.random.default_rng(0).integers(0, 256, (1, 1, 6, 4, 5, 3), np.uint8)
    found = pixels_of(images, np.random.default_rng(0), NO_AUGMENTATION)[0].numpy()
    mean, std = np.array(HIGHWAY.image.mean), np.array(HIGHWAY.image.std)
    wanted = (images[0, 0] - mean) / std
    assert found == pytest.approx(wanted.transpose(0, 3, 1, 2), abs=1e-6)


def test_light_changes_every_camera_for_itself() -> None:
    images = np.full((1, 1, 6, 4, 5, 3), 200, np.uint8)
    how = replace(NO_AUGMENTATION, light=0.12)
    found = pixels_of(images, np.random.default_rng(0), how)[0]
    levels = found.flatten(1).unique(dim=1)
    assert levels.shape == (6, 1)
    assert len(levels.unique()) == 6
    assert (levels * STD + MEAN).std() > 5


def test_the_planner_alone_reads_what_the_others_said(
    model: Highway, lamps: LampHead, episodes: Episodes, tmp_path: Path
) -> None:
    model.eval()
    cache = PlannerInputCache.of(model, episodes, LIDAR2IMG, tmp_path / "inputs")
    picked = np.arange(len(episodes))
    rows = episodes.rows(picked)
    rng = np.random.default_rng(0)
    with torch.no_grad():
        found = run_planner(model, cache.world(picked), rows, rng, NO_AUGMENTATION)
        images = episodes.images(picked)[None]
        batch = episodes.batch(picked[None])
        wanted = run(
            model, lamps, images, batch, LIDAR2IMG, rng, NO_AUGMENTATION
        ).losses
    assert {k: float(v) for k, v in found.items()} == pytest.approx(
        {k: float(wanted[k]) for k in PLAN}, rel=0.05, abs=0.02
    )


@pytest.fixture(scope="module")
def world(model: Highway, lamps: LampHead, episodes: Episodes) -> PlannerInput:
    return outcome(model, lamps, episodes, NO_AUGMENTATION, 2).world


def told(world: PlannerInput, no_occ: float, overlooked: float) -> PlannerInput:
    how = replace(NO_AUGMENTATION, no_occ=no_occ, overlooked=overlooked)
    return without_rivals(world, np.random.default_rng(0), how)


def changed(before: PlannerInput, after: PlannerInput) -> set[str]:
    names = [field.name for field in fields(PlannerInput)]
    return {n for n in names if not torch.equal(getattr(before, n), getattr(after, n))}


def test_agents_or_occupancy_are_dropped_and_never_both(world: PlannerInput) -> None:
    found = told(world, 0.0, 0.5)
    assert changed(world, found) == {"score"}
    shown = found.score == world.score
    assert 0.3 < shown.float().mean() < 0.7
    assert not found.score[~shown].any()
    found = told(world, 1.0, 1.0)
    assert changed(world, found) == {"occupancy"}
    assert torch.equal(found.occupancy, world.occupancy.mean(0).expand(4, -1, -1, -1))
    assert changed(world, told(world, 0.0, 0.0)) == set()


@torch.no_grad()
def test_an_overlooked_agent_tells_the_planner_nothing(
    model: Highway, world: PlannerInput
) -> None:
    planner, blind = model.eval().planner, told(world, 0.0, 1.0)
    ego, command = torch.tensor([[0.5, 0.0]]).expand(4, -1), torch.zeros(4).long()
    other = replace(
        blind,
        agents=blind.agents + 1,
        boxes=blind.boxes + 1,
        travel=blind.travel - 1,
        modes=blind.modes.flip(-1),
    )
    logits = [planner.consider(one, ego, command).logits for one in (blind, other)]
    assert torch.equal(*logits)
    seen = planner.consider(replace(other, score=world.score), ego, command).logits
    assert not torch.equal(seen, logits[0])


@torch.no_grad()
def test_the_driver_remembers_as_it_learned_to(
    model: Highway, episodes: Episodes
) -> None:
    """One frame after the other comes to the same view as a sequence in training."""
    encoder, picked = model.eval().bev_encoder, np.arange(len(episodes))
    batch = episodes.batch(picked[None])
    rng = np.random.default_rng(0)
    fine, _ = model.look(pixels_of(episodes.images(picked)[None], rng, NO_AUGMENTATION))
    calibration = LIDAR2IMG.expand(len(picked), -1, -1, -1)
    wanted = encoder.fuse(remember(model, encoder.look(fine, calibration), batch))
    memory = torch.zeros(1, encoder.area.cells, LITTLE.channels + RECORD)
    found = list[torch.Tensor]()
    for index in picked:
        bev, _, memory = encoder(
            fine[6 * index : 6 * index + 6],
            LIDAR2IMG[None],
            torch.from_numpy(batch["can_bus"][:, index]),
            torch.tensor([0.2]),
            memory,
        )
        found.append(bev)
    assert torch.cat(found).numpy() == pytest.approx(wanted.numpy(), abs=1e-5)
