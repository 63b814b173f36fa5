"""Every loss is nothing for perfect answers, and something for others."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from me2e_compress.simulator.camera_rig import CameraRig
from models.driver.label_tensors import Labels, labels_of
from models.driver.losses import (
    LampHead,
    map_losses,
    motion_losses,
    occ_losses,
    plan_losses,
    track_losses,
)
from models.driver.losses.detection_losses import focal_loss, match
from models.driver.losses.planning_losses import (
    displacement,
    doomed,
    true_harm,
)
from models.driver.network.config import BevArea
from models.driver.network.interfaces import Candidates
from models.driver.network.map import GAP_SCALE_M, RoadMap
from models.driver.network.motion import Futures
from models.driver.network.track import Tracks
from models.tests.driver.made import arrays_of

AREA = BevArea()
SURE = 25.0
"""A logit that leaves no doubt."""


@pytest.fixture
def wanted() -> Labels:
    arrays = arrays_of(2, size=(16, 24))
    arrays["ground"][:] = 3  # road everywhere
    arrays["occupancy"][:] = 0
    arrays["signals"][:, 0, 1] = 2  # green
    return labels_of({**arrays, "moves": arrays["plan"], "shift_m": np.ones(2)}, AREA)


def logits(where: Tensor) -> Tensor:
    return torch.where(where > 0, SURE, -SURE)


def perfect_road(wanted: Labels) -> RoadMap:
    def of_command(rows: Tensor) -> Tensor:
        routes = torch.full((len(rows), 6, *rows.shape[1:]), 99.0)
        routes[torch.arange(len(rows)), wanted.command] = rows
        return routes

    there, gap, state = wanted.signals.unbind(-1)
    light = logits(nn.functional.one_hot(state[:, 0].clamp(min=0).long(), 3))
    colours = torch.zeros(len(there), 3, 3)
    colours[:, 0] = light
    signals = torch.cat([logits(there)[..., None], gap[..., None] / GAP_SCALE_M], -1)
    return RoadMap(
        torch.zeros(2, 150, 64),
        torch.zeros(2, 6),
        of_command(torch.zeros(2, 25)),
        of_command(wanted.path),
        of_command(wanted.attributes),
        logits(wanted.raster),
        torch.zeros(2, 3, 64),
        torch.cat([signals, colours], -1),
        of_command(wanted.path),
    )


def perfect_tracks(wanted: Labels) -> Tracks:
    """The first queries are the agents, the rest is nobody."""
    order = [1, 2, 5, 6, 3, 4, 7, 8]
    boxes = wanted.agents[..., order].clone()
    boxes[..., 2:4].clamp_(min=0.1)
    there = wanted.there.float()
    boxes[..., :2] += 1000 * (1 - there)[..., None]  # nobody is far from everybody
    heat = torch.zeros(2, AREA.cells).scatter_add(1, wanted.cells, there)
    kinds = nn.functional.one_hot(wanted.agents[..., 0].clamp(min=0).long(), 4)
    return Tracks(
        torch.zeros(2, 24, 64),
        boxes,
        there,
        logits(kinds),
        logits(heat),
        wanted.cells,
        logits(there),
    )


def perfect_futures(wanted: Labels) -> Futures:
    travel = torch.stack([wanted.travel, wanted.travel + 50], 2)
    modes = torch.tensor([SURE, -SURE]).expand(2, 24, 2)
    return Futures(torch.zeros(2, 24, 64), travel, modes)


def candidates(wanted: Labels, away_m: float = 3.0) -> Candidates:
    """The expert's plan, and one that falls short of it."""
    short = torch.tensor([0.0, -away_m])[:, None, None] * torch.tensor([1.0, 0.0])
    moves = wanted.moves[:, None] + short
    return Candidates(
        plans=moves.clone(),
        headings=torch.zeros(moves.shape[:3]),
        moves=moves,
        anchors=moves,
        logits=torch.tensor([SURE, -SURE]).expand(2, 2).clone(),
        costs=torch.zeros(2, 2, 1),
    )


def test_perfect_answers_cost_nothing(wanted: Labels) -> None:
    tracks = perfect_tracks(wanted)
    owner, mine = match(tracks, wanted)
    found = {
        **map_losses(perfect_road(wanted), wanted),
        **track_losses(tracks, wanted, AREA, owner, mine),
        **motion_losses(perfect_futures(wanted), wanted, owner, mine),
        **occ_losses(logits(wanted.occupancy), wanted),
        **plan_losses(candidates(wanted), wanted, AREA),
    }
    numbers = {name: float(loss) for name, loss in found.items()}
    assert numbers == pytest.approx(dict.fromkeys(found, 0.0), abs=1e-4)
    assert len(found) > 12


@pytest.mark.parametrize(
    ("field", "shift", "loss"),
    [
        ("paths", 1.0, "path"),
        ("rough", 1.0, "path"),
        ("headings", 0.3, "heading"),
        ("attributes", 1.0, "attributes"),
        ("raster", -2 * SURE, "raster"),
        ("signals", -2 * SURE, "signal"),
        ("signals", 1.0, "line"),
    ],
)
def test_a_wrong_map_costs_where_it_is_wrong(
    wanted: Labels, field: str, shift: float, loss: str
) -> None:
    road = perfect_road(wanted)
    wrong = replace(road, **{field: getattr(road, field) + shift})
    assert map_losses(wrong, wanted)[loss] > 0.05


def test_a_light_of_another_colour_costs(wanted: Labels) -> None:
    road = perfect_road(wanted)
    road.signals[:, 0, 2:] = torch.tensor([SURE, -SURE, -SURE])
    assert map_losses(road, wanted)["colour"] > 1


def test_routes_of_other_commands_do_not_matter(wanted: Labels) -> None:
    road = perfect_road(wanted)
    road.paths[:, 0] += 5
    assert map_losses(road, wanted)["path"] == pytest.approx(0, abs=1e-5)


def test_every_agent_gets_the_nearest_query(wanted: Labels) -> None:
    tracks = perfect_tracks(wanted)
    shuffled = torch.randperm(24, generator=torch.Generator().manual_seed(0))
    tracks.boxes = tracks.boxes[:, shuffled]
    owner, mine = match(tracks, wanted)
    found = {int(owner[0, q]): int(shuffled[q]) for q in mine[0].nonzero()[:, 0]}
    assert found == {0: 0, 1: 1}


def test_a_query_far_from_everybody_is_nobodys(wanted: Labels) -> None:
    tracks = perfect_tracks(wanted)
    tracks.boxes[0, 0, 0] += 4.5
    _, mine = match(tracks, wanted)
    assert mine[0].tolist() == [False, True] + [False] * 22


@pytest.mark.parametrize(
    ("field", "shift", "loss"),
    [
        ("heat", -2 * SURE, "heat"),
        ("logits", -2 * SURE, "score"),
        ("boxes", 1.0, "box"),
    ],
)
def test_wrong_tracks_cost(wanted: Labels, field: str, shift: float, loss: str) -> None:
    tracks = perfect_tracks(wanted)
    owner, mine = match(tracks, wanted)
    wrong = replace(tracks, **{field: getattr(tracks, field) + shift})
    assert track_losses(wrong, wanted, AREA, owner, mine)[loss] > 0.2


def test_only_the_best_mode_must_be_right_and_known(wanted: Labels) -> None:
    owner, mine = match(perfect_tracks(wanted), wanted)
    futures = perfect_futures(wanted)
    futures.logits = -futures.logits
    losses = motion_losses(futures, wanted, owner, mine)
    assert losses["travel"] == pytest.approx(0, abs=1e-6)
    assert losses["mode"] > 1
    wanted.travel_known[:] = False
    futures.travel = futures.travel + 7
    assert motion_losses(futures, wanted, owner, mine)["travel"] == 0


def test_occupancy_of_unknown_steps_costs_nothing(wanted: Labels) -> None:
    wanted.occupancy_known[:] = False
    assert occ_losses(torch.zeros(wanted.occupancy.shape), wanted)["occ"] == 0


@pytest.mark.parametrize(
    ("away_m", "loss", "least"), [(3.0, "choice", 1.0), (-18.0, "safe", 0.3)]
)
def test_the_wrong_choice_costs_and_into_the_car_ahead_it_is_not_safe(
    wanted: Labels, away_m: float, loss: str, least: float
) -> None:
    chosen = candidates(wanted, away_m)
    chosen.logits = -chosen.logits
    assert plan_losses(chosen, wanted, AREA)[loss] > least


def test_harm_is_a_car_a_red_light_and_ground_that_is_no_road(wanted: Labels) -> None:
    harm = true_harm(candidates(wanted, away_m=-18.0), wanted, AREA)
    assert harm[0].tolist() == pytest.approx([0, 1], abs=0.1)
    wanted.signals[:, 0] = torch.tensor([1.0, 10.0, 0.0])  # beyond its line
    harm = true_harm(candidates(wanted, away_m=12.0), wanted, AREA)
    assert harm[0].tolist() == pytest.approx([1, 0], abs=0.1)
    wanted.signals[:, 0, 0] = 0.0
    assert (true_harm(candidates(wanted), wanted, AREA) < 1).any()
    wanted.raster[:] = 0
    assert (true_harm(candidates(wanted), wanted, AREA) >= 1).all()


def test_a_plan_into_the_car_ahead_is_no_example(wanted: Labels) -> None:
    assert doomed(wanted).tolist() == [False, False]
    ahead = wanted.plan[0] + torch.tensor([18.0, 0.0])  # into the car 20 m ahead
    into = replace(wanted, plan=torch.stack([ahead, wanted.plan[1]]))
    assert doomed(into).tolist() == [True, False]


def test_displacement_is_in_metres(wanted: Labels) -> None:
    away = displacement(wanted.plan + torch.tensor([3.0, 4.0]), wanted)
    assert away.tolist() == pytest.approx([5, 5])


class Fixed(nn.Module):
    """Says what it was told to say."""

    def __init__(self, said: Tensor) -> None:
        super().__init__()
        self.said = said

    def forward(self, features: Tensor) -> Tensor:
        return self.said


def lamp_loss(wanted: Labels, said: Tensor) -> Tensor:
    head = LampHead(4)
    head.head = Fixed(said)  # type: ignore[assignment]
    lidar2img = torch.from_numpy(CameraRig(96, 160).lidar2img).expand(2, -1, -1, -1)
    found: Tensor = head(torch.zeros(12, 4, 24, 40), lidar2img, wanted)["lamp"]
    return found


def test_the_lamp_is_where_the_camera_sees_it(wanted: Labels) -> None:
    nothing = torch.full((12, 5, 24, 40), -SURE)
    right = list[tuple[int, ...]]()
    for cell in np.ndindex(24, 40):
        said = nothing.clone()
        said[0::6, 2, *cell] = SURE  # the front camera, green
        if lamp_loss(wanted, said) < 1e-3:
            right.append(cell)
    ((row, column),) = right
    # 18 m ahead and 2 m to the left, a little above the camera
    assert row < 12
    assert 14 < column < 20


def test_a_lamp_seen_from_behind_shows_nothing(wanted: Labels) -> None:
    nothing = torch.full((12, 5, 24, 40), -SURE)
    assert lamp_loss(wanted, nothing) > 1
    wanted.lamps[..., 4] = -1
    assert lamp_loss(wanted, nothing) < 1e-6


def test_focal_loss_by_hand() -> None:
    found = focal_loss(
        torch.tensor([0.0, 0.0, 0.0]),
        torch.tensor([1.0, 0.0, 0.0]),
        torch.tensor([1.0, 0.5, 0.0]),
    )
    assert float(found) == pytest.approx(0.25 * np.log(2) * (1 + 0.5 + 1))
