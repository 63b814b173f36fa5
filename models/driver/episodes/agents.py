"""The actors of a scene, where they went, and which ground they then covered."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.scene import Actor, Ego, PixelClass, Scene
from models.driver.episodes.birdseye import ACTOR_CLASSES, BirdseyeGrid, covered

AGENTS = 24
AGENT_COLUMNS = 10
FUTURE_STEPS, FUTURE_US = 6, 500_000
REACH_M = ((-16.0, 48.0), (-24.0, 24.0))
"""Where the centre of an agent may be: x and y in the ego frame."""
GRID = BirdseyeGrid(front_m=48.0, left_m=24.0, cell_m=1.0, rows=64, columns=48)
CLASSES = {
    PixelClass.VEHICLE: 0.0,
    PixelClass.BICYCLE: 1.0,
    PixelClass.PEDESTRIAN: 2.0,
    PixelClass.STATIC: 3.0,
}


def agents(scene: Scene, future: Sequence[Scene | None]) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of the actors at one instant, see the package.

    Args:
        scene: Now.
        future: The scenes 0.5, 1 .. 3 s later; None after the end of the route.
    """
    near = _nearest(scene)
    rows = np.full((AGENTS, AGENT_COLUMNS), -1.0, np.float32)
    rows[:, 1:] = 0.0
    ways = np.full((AGENTS, FUTURE_STEPS, 2), np.nan, np.float32)
    for row, actor in enumerate(near):
        rows[row] = _row(actor, scene.ego)
    place = {actor.id: row for row, actor in enumerate(near)}
    occupancy = np.zeros((FUTURE_STEPS, GRID.rows, GRID.columns), bool)
    for step, later in enumerate(future):
        if later is None:
            continue
        known = [actor for actor in later.actors if actor.id in place]
        ways[[place[actor.id] for actor in known], step] = _centres(known, scene.ego)
        occupancy[step] = covered(later.actors, scene.ego, GRID)
    return {
        "agents": rows,
        "futures": ways,
        "occupancy": np.packbits(occupancy.reshape(FUTURE_STEPS, -1), axis=1),
        "known_steps": np.array(sum(later is not None for later in future), np.int64),
    }


def _centres(actors: Sequence[Actor], ego: Ego) -> Floats:
    """Return [N, 2] centres in the ego frame."""
    x = np.array([actor.x for actor in actors])
    y = np.array([actor.y for actor in actors])
    return ego.seen(x, y)


def _nearest(scene: Scene) -> list[Actor]:
    """Return at most `AGENTS` actors within `REACH_M`, the nearest first."""
    centres = _centres(scene.actors, scene.ego)
    (back, front), (right, left) = REACH_M
    x, y = centres[:, 0], centres[:, 1]
    inside = (x >= back) & (x <= front) & (y >= right) & (y <= left)
    order = np.argsort(np.hypot(x, y), kind="stable")
    return [scene.actors[i] for i in order if inside[i]][:AGENTS]


def _row(actor: Actor, ego: Ego) -> list[float]:
    ((x, y),) = _centres([actor], ego)
    turn = actor.heading - ego.heading
    cos, sin = float(np.cos(turn)), float(np.sin(turn))
    box = [actor.length, actor.width]
    velocity = [actor.speed_mps * cos, actor.speed_mps * sin]
    kind = CLASSES[ACTOR_CLASSES[actor.kind]]
    return [kind, float(x), float(y), cos, sin, *box, *velocity, float(actor.braking)]
