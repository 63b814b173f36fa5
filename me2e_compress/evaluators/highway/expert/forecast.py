"""Forecasts of all actors for the next six seconds, from their intents."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.plane_geometry import Floats, RoutePath
from me2e_compress.simulator.privileged import Intent
from me2e_compress.simulator.scene import Actor, ActorKind, Scene

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


def forecast(
    scene: Scene, intents: Mapping[int, Intent], path: RoutePath, ego_s_m: float
) -> Forecast:
    """Roll out all actors near the ego; without intent they keep course and speed."""
    ego = scene.ego
    # poses of the actors that can matter, [A, 4, T]
    near = [
        actor
        for actor in scene.actors
        if math.hypot(actor.x - ego.x, actor.y - ego.y) < REACH_M
    ]
    rolled = [_roll_out(actor, intents.get(actor.id)) for actor in near]
    poses = np.array(rolled).reshape(len(near), 4, len(NOW_S))
    x, y, heading, speed = poses.transpose(1, 0, 2)
    # their places relative to the route
    along, lateral, away = _on_route(path, x, y, heading, ego_s_m)
    return Forecast(
        *(x, y, heading, speed),
        goal_mps=np.array([_goal(a, intents.get(a.id)) for a in near]),
        length=np.array([actor.length for actor in near]),
        width=np.array([actor.width for actor in near]),
        moves=np.array([actor.kind not in FIXED for actor in near], bool),
        yields=np.array([_yields(intents.get(actor.id)) for actor in near], bool),
        emergency=np.array([a.kind is ActorKind.EMERGENCY for a in near], bool),
        walks=np.array([a.kind is ActorKind.PEDESTRIAN for a in near], bool),
        along_m=along,
        lateral_m=lateral,
        away=away,
    )


def _yields(intent: Intent | None) -> bool:
    return intent is not None and intent.sees_ego


def _roll_out(actor: Actor, intent: Intent | None) -> Floats:
    """Return [4, T]: x, y, heading, speed at `NOW_S`."""
    first = 0.0 if intent is None else intent.acceleration_mps2
    briskest = max(first, EASY_MPS2)
    goal = _goal(actor, intent)
    # pedestrians and cyclists reach their speed at once
    if actor.kind in ON_FOOT:
        first = briskest = 4.0 if goal > actor.speed_mps else 0.0
    speed, travel = _speeds(actor.speed_mps, goal, first, briskest)
    # without a path an actor goes straight on
    if intent is None or len(intent.path) < 2:
        x = actor.x + travel * np.cos(actor.heading)
        y = actor.y + travel * np.sin(actor.heading)
        return np.stack([x, y, np.full_like(x, actor.heading), speed])
    return np.vstack([_along(actor, intent.path, travel), speed])


def _goal(actor: Actor, intent: Intent | None) -> float:
    return actor.speed_mps if intent is None else intent.target_mps


def _speeds(
    now: float, goal: float, first: float, briskest: float
) -> tuple[Floats, Floats]:
    """Return speeds and distances at `NOW_S`: hold for 1 s, then move to the goal.

    ``first`` is the acceleration of the first second, ``briskest`` the strongest one
    later: an actor that crawls behind another will not leap ahead.
    """
    hardest = min(first, -2.0)
    speed, travel = [now], [0.0]
    for begin, step in STEPS_S:
        wish = min(max((goal - speed[-1]) / step, hardest), briskest)
        rate = wish
        if begin < 1.0:
            rate = min(first, max(wish, 0.0)) if first > 0 else first
        after = max(speed[-1] + rate * step, 0.0)
        travel.append(travel[-1] + (speed[-1] + after) / 2 * step)
        speed.append(after)
    return np.array(speed), np.array(travel)


def _along(actor: Actor, line: Floats, travel: Floats) -> Floats:
    """Return [3, T] x, y and heading on a line that begins at the actor."""
    steps = line[1:] - line[:-1]
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))])
    headings = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
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
    nearest = np.argmin(gap_x * gap_x + gap_y * gap_y, axis=-1)
    at, course = points[nearest], headings[nearest]
    # offsets along and across the route there
    dx, dy = x - at[..., 0], y - at[..., 1]
    along = low + nearest + np.cos(course) * dx + np.sin(course) * dy
    lateral = np.cos(course) * dy - np.sin(course) * dx
    away = np.mod(heading - course + np.pi, 2 * np.pi) - np.pi
    return along, lateral, away
