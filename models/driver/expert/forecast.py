"""Forecasts of all actors for the next six seconds, from their intents."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.plane_geometry import Floats, RoutePath
from me2e_compress.simulator.scene import Actor, ActorKind, Scene
from models.driver.expert.privileged import Intent

Flags = npt.NDArray[np.bool_]
TIMES_S = np.concatenate([np.arange(0.25, 3.01, 0.25), np.arange(3.5, 6.01, 0.5)])
"""[18] seconds: fine for the three seconds of the plan, coarse after."""
NOW_S = np.concatenate([[0.0], TIMES_S])
STEPS_S = tuple(zip(NOW_S[:-1].tolist(), np.diff(NOW_S).tolist(), strict=True))
"""Where each begins and its length: numbers of Python are faster one by one."""
REACH_M = 150.0
"""Range of the actors that are considered; oncoming ones matter early."""
ROUTE_SPAN_M = (-60.0, 160.0)
"""Part of the route, from the ego, onto which actors are projected."""
EASY_MPS2 = 0.3
"""Least acceleration of an actor below its desired speed."""


@dataclass(frozen=True, eq=False)
class Forecast:
    """Boxes of A actors now and at the 18 times of `TIMES_S` (T = 19 columns).

    Positions, speeds and headings are [A, T], in SI units; ``along_m`` and
    ``lateral_m`` (left) are relative to the route, and so is the heading ``away``. The
    other arrays are [A]: ``goal_mps`` is the desired speed, ``yields`` tells whether an
    actor brakes for the ego.
    """

    x: Floats
    y: Floats
    heading: Floats
    speed_mps: Floats
    goal_mps: Floats
    length: Floats
    width: Floats
    moves: Flags
    yields: Flags
    emergency: Flags
    walks: Flags
    along_m: Floats
    lateral_m: Floats
    away: Floats

    @property
    def half_span(self) -> Floats:
        """[A, T] half of the box's extent along the route."""
        cos, sin = np.abs(np.cos(self.away)), np.abs(np.sin(self.away))
        return (cos * self.length[:, None] + sin * self.width[:, None]) / 2

    @property
    def half_breadth(self) -> Floats:
        """[A, T] half of the box's extent across the route."""
        cos, sin = np.abs(np.cos(self.away)), np.abs(np.sin(self.away))
        return (sin * self.length[:, None] + cos * self.width[:, None]) / 2


ON_FOOT = (ActorKind.PEDESTRIAN, ActorKind.BICYCLE)
FIXED = (ActorKind.PARKED, ActorKind.DOOR, ActorKind.CONE, ActorKind.BARRIER)


def near(scene: Scene) -> list[Actor]:
    """Return the actors that can matter to the ego."""
    ego = scene.ego
    return [
        actor
        for actor in scene.actors
        if math.hypot(actor.x - ego.x, actor.y - ego.y) < REACH_M
    ]


def forecast(
    scene: Scene, intents: Mapping[int, Intent], path: RoutePath, ego_s_m: float
) -> Forecast:
    """Roll out all actors near the ego; without intent they keep course and speed."""
    actors = near(scene)
    plans = [intents.get(actor.id) for actor in actors]
    # speeds and distances of all, then where these take each, [A, 3, T]
    goal = np.array(
        [
            actor.speed_mps if plan is None else plan.target_mps
            for actor, plan in zip(actors, plans, strict=True)
        ]
    )
    speed, travel = _speeds(actors, plans, goal)
    ways = [_moved(*each) for each in zip(actors, plans, travel, strict=True)]
    poses = np.array(ways).reshape(len(actors), 3, len(NOW_S))
    x, y, heading = poses.transpose(1, 0, 2)
    # their places relative to the route
    along, lateral, away = _on_route(path, x, y, heading, ego_s_m)
    return Forecast(
        *(x, y, heading, speed),
        goal_mps=goal,
        length=np.array([actor.length for actor in actors]),
        width=np.array([actor.width for actor in actors]),
        moves=np.array([actor.kind not in FIXED for actor in actors], bool),
        yields=np.array([plan is not None and plan.sees_ego for plan in plans], bool),
        emergency=np.array([a.kind is ActorKind.EMERGENCY for a in actors], bool),
        walks=np.array([a.kind is ActorKind.PEDESTRIAN for a in actors], bool),
        along_m=along,
        lateral_m=lateral,
        away=away,
    )


def _speeds(
    actors: Sequence[Actor], plans: Sequence[Intent | None], goal: Floats
) -> tuple[Floats, Floats]:
    """Return speeds and distances at `NOW_S`, both [A, T].

    Each holds its acceleration for 1 s, then moves to its goal, and an actor that
    crawls behind another does not leap ahead.
    """
    now = np.array([actor.speed_mps for actor in actors])
    first = np.array(
        [0.0 if plan is None else plan.acceleration_mps2 for plan in plans]
    )
    briskest = np.maximum(first, EASY_MPS2)
    # pedestrians and cyclists reach their speed at once
    on_foot = np.array([actor.kind in ON_FOOT for actor in actors], bool)
    at_once = np.where(goal > now, 4.0, 0.0)
    first = np.where(on_foot, at_once, first)
    briskest = np.where(on_foot, at_once, briskest)
    hardest = np.minimum(first, -2.0)
    speed, travel = [now], [np.zeros_like(now)]
    for begin, step in STEPS_S:
        wish = np.minimum(np.maximum((goal - speed[-1]) / step, hardest), briskest)
        if begin < 1.0:
            gentle = np.minimum(first, np.maximum(wish, 0.0))
            wish = np.where(first > 0, gentle, first)
        after = np.maximum(speed[-1] + wish * step, 0.0)
        travel.append(travel[-1] + (speed[-1] + after) / 2 * step)
        speed.append(after)
    return np.stack(speed, axis=1), np.stack(travel, axis=1)


def _moved(actor: Actor, plan: Intent | None, travel: Floats) -> Floats:
    """Return [3, T] x, y and heading: on its way, or straight on without one."""
    if plan is None or len(plan.path) <= 1:
        x = actor.x + travel * np.cos(actor.heading)
        y = actor.y + travel * np.sin(actor.heading)
        return np.stack([x, y, np.full_like(x, actor.heading)])
    # its way begins at the actor
    line = plan.path
    steps = line[1:] - line[:-1]
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))])
    headings = np.arctan2(steps[:, 1], steps[:, 0])
    # numpy's unwrap takes as long as all the rest, and few ways pass half a turn
    if np.any(np.abs(headings[1:] - headings[:-1]) >= np.pi):
        headings = np.unwrap(headings)
    heading = np.interp(travel, (arc[:-1] + arc[1:]) / 2, headings)
    over = np.maximum(travel - arc[-1], 0.0)
    x = np.interp(travel, arc, line[:, 0]) + over * np.cos(heading)
    y = np.interp(travel, arc, line[:, 1]) + over * np.sin(heading)
    heading[0] = actor.heading
    return np.stack([x, y, heading])


def _on_route(
    path: RoutePath, x: Floats, y: Floats, heading: Floats, ego_s_m: float
) -> tuple[Floats, Floats, Floats]:
    """Return arc length, lateral offset and relative heading, each [A, T]."""
    low = int(max(ego_s_m + ROUTE_SPAN_M[0], 0))
    high = int(min(ego_s_m + ROUTE_SPAN_M[1], len(path.points)))
    points, headings = path.points[low:high], path.headings[low:high]
    # nearest point of the route, one per metre
    gap_x, gap_y = x[..., None] - points[:, 0], y[..., None] - points[:, 1]
    np.multiply(gap_x, gap_x, out=gap_x)
    gap_x += np.multiply(gap_y, gap_y, out=gap_y)
    nearest = np.argmin(gap_x, axis=-1)
    at, course = points[nearest], headings[nearest]
    # offsets along and across the route there
    dx, dy = x - at[..., 0], y - at[..., 1]
    along = low + nearest + np.cos(course) * dx + np.sin(course) * dy
    lateral = np.cos(course) * dy - np.sin(course) * dx
    away = np.mod(heading - course + np.pi, 2 * np.pi) - np.pi
    return along, lateral, away
