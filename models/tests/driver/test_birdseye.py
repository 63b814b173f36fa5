from dataclasses import replace

import numpy as np
import pytest

from me2e_compress.base.errors import EvaluationError
from me2e_compress.simulator.cameras.ground import GroundTexture
from me2e_compress.simulator.scene import ActorKind, PixelClass, Scene
from models.driver.episodes.birdseye import (
    BirdseyeGrid,
    bev_classes,
    covered,
    ground_classes,
)
from tests.simulator.cameras import town
from tests.simulator.cameras.conftest import texture

__all__ = ["texture"]

GRID = BirdseyeGrid(front_m=40.0, left_m=20.1, cell_m=0.2, rows=300, columns=201)


def at(texture: GroundTexture, scene: Scene, x: float, y: float) -> PixelClass:
    """Class of the cell that holds a point of the ego frame."""
    column, row = GRID.cells(np.array([x, y]))
    return PixelClass(int(bev_classes(scene, texture, GRID)[int(row), int(column)]))


@pytest.mark.parametrize(
    ("x", "y", "kind"),
    [
        (0.1, 0.1, PixelClass.EGO),
        (10.1, 3.6, PixelClass.VEHICLE),
        (8.1, -1.4, PixelClass.PEDESTRIAN),
        (-9.9, 0.1, PixelClass.STATIC),
        (5.1, 0.1, PixelClass.DRIVABLE),
        (5.1, -2.0, PixelClass.LANE_MARKING),
        (20.1, 3.1, PixelClass.STOP_LINE),
        (5.1, -8.1, PixelClass.TERRAIN),
    ],
)
def test_what_lies_where(
    texture: GroundTexture, x: float, y: float, kind: PixelClass
) -> None:
    scene = town.scene(
        town.actor(10.0, 4.0),
        town.actor(8.0, -1.5, ActorKind.PEDESTRIAN),
        town.actor(-10.0, 0.0, ActorKind.BARRIER),
    )
    assert at(texture, scene, x, y) is kind


def test_the_grid_turns_with_the_ego(texture: GroundTexture) -> None:
    # looking north from the lane at y = 0: the car to the east is on the right
    scene = town.scene(town.actor(10.0, 0.0), seen_from=town.ego(0.0, 0.0, np.pi / 2))
    assert at(texture, scene, 0.1, -10.1) is PixelClass.VEHICLE
    assert at(texture, scene, 15.1, 0.1) is PixelClass.TERRAIN
    assert at(texture, scene, 3.9, -15.1) is PixelClass.DRIVABLE


def test_a_crosswalk_is_seen_from_above(texture: GroundTexture) -> None:
    scene = town.scene(seen_from=town.ego(12.0, 2.0))
    assert (bev_classes(scene, texture, GRID) == PixelClass.CROSSWALK).sum() > 50


def test_an_empty_grid_is_refused() -> None:
    with pytest.raises(EvaluationError, match=r"grid of 0 x 200 cells .* positive"):
        BirdseyeGrid(rows=0)


def test_the_ground_is_what_lies_under_the_ego(texture: GroundTexture) -> None:
    scene = town.scene()
    seen = bev_classes(scene, texture, GRID)

    ground = ground_classes(scene.ego, texture, GRID)

    ego = seen == PixelClass.EGO
    assert np.array_equal(ground[~ego], seen[~ego])
    assert np.all(ground[ego] == PixelClass.DRIVABLE)


def test_a_box_covers_what_its_class_is_painted_on(texture: GroundTexture) -> None:
    car = town.actor(10.0, 4.0)
    scene = town.scene(car)

    touched = covered([car], scene.ego, GRID)

    assert np.array_equal(
        touched, bev_classes(scene, texture, GRID) == PixelClass.VEHICLE
    )


@pytest.mark.parametrize("turn", [0.0, 0.7, 2.0])
def test_nobody_is_skipped_who_touches_the_edge(
    texture: GroundTexture, turn: float
) -> None:
    small = BirdseyeGrid(8.0, 6.0, 1.0, 16, 12)
    ego = replace(town.scene().ego, heading=turn)
    found = list[bool]()
    for x in range(-13, 14):
        for y in range(-11, 12):
            car = replace(town.actor(0.0, 0.0), x=ego.x + x, y=ego.y + y)
            painted = bev_classes(replace(town.scene(car), ego=ego), texture, small)
            touched = covered([car], ego, small)
            wanted = painted == PixelClass.VEHICLE
            rest = painted != PixelClass.EGO
            assert np.array_equal(touched & rest, wanted), (x, y)
            found.append(bool(touched.any()))
    assert 0.2 < np.mean(found) < 0.8
