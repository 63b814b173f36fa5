"""Distance, TTC and PET of a drive, and who was at fault in a collision.

They are computed once, after the route, over all its frames: about 1 % of the time that
driving it takes.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from me2e_compress.metrics.episode import (
    CROSSING_RAD,
    FRAME_US,
    PET_HORIZON_S,
    TTC_HORIZON_S,
    ConflictRecord,
    Contact,
    Encounter,
)
from me2e_compress.simulator.plane_geometry import Roadmap
from me2e_compress.simulator.scene import Actor, ActorKind, Ego, Scene

Floats = npt.NDArray[np.float64]


def corners(boxes: Floats) -> Floats:
    """Return [..., 4, 2] corners: front left and right, rear right and left."""
    signs = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])
    along = signs[:, 0] * boxes[..., 3:4] / 2
    left = signs[:, 1] * boxes[..., 4:5] / 2
    cos, sin = np.cos(boxes[..., 2:3]), np.sin(boxes[..., 2:3])
    x = boxes[..., 0:1] + along * cos - left * sin
    y = boxes[..., 1:2] + along * sin + left * cos
    return np.stack([x, y], axis=-1)


def overlaps(one: Floats, other: Floats) -> npt.NDArray[np.bool_]:
    """Return [...] whether two boxes touch or overlap (separating axes)."""
    apart = _along_axes(one, other, other[..., :2] - one[..., :2])
    return np.asarray((np.abs(apart) <= _room(one, other)).all(axis=-1))


def gaps(one: Floats, other: Floats) -> Floats:
    """Return [...] metres between the outlines of two boxes, 0 where they overlap.

    Between disjoint convex outlines, a corner of one is the nearest point.
    """
    nearest = np.minimum(_from_corners(one, other), _from_corners(other, one))
    return np.where(overlaps(one, other), 0.0, nearest)


def contact_times(one: Floats, other: Floats, approach: Floats) -> Floats:
    """Return [...] seconds until two boxes touch, infinite if they never do.

    Both keep their heading and velocity; ``approach`` [..., 2] is the velocity of the
    other minus that of the first, m/s. The answer is exact: the boxes touch while their
    projections on all four axes overlap.
    """
    # interval of contact on each axis
    apart = _along_axes(one, other, other[..., :2] - one[..., :2])
    speed, room = _along_axes(one, other, approach), _room(one, other)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        edges = np.stack([(-room - apart) / speed, (room - apart) / speed])
    begins, ends = edges.min(axis=0), edges.max(axis=0)
    # on an axis without motion, contact is always or never
    still, inside = speed == 0.0, np.abs(apart) <= room
    begins = np.where(still, np.where(inside, -np.inf, np.inf), begins).max(axis=-1)
    ends = np.where(still, np.where(inside, np.inf, -np.inf), ends).min(axis=-1)
    touches = (begins <= ends) & (ends >= 0.0)
    return np.where(touches, np.maximum(begins, 0.0), np.inf)


def _along_axes(one: Floats, other: Floats, vectors: Floats) -> Floats:
    """Return [..., 4] vectors along and across the first box and the other."""
    columns: list[Any] = []
    for box in (one, other):
        cos, sin = np.cos(box[..., 2]), np.sin(box[..., 2])
        columns.append(vectors[..., 0] * cos + vectors[..., 1] * sin)
        columns.append(vectors[..., 1] * cos - vectors[..., 0] * sin)
    return np.stack(columns, axis=-1)


def _room(one: Floats, other: Floats) -> Floats:
    """Return [..., 4] centre distances at contact, on each axis."""
    turn = other[..., 2] - one[..., 2]
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    columns = []
    for box, second in ((one, other), (other, one)):
        length, width = second[..., 3], second[..., 4]
        columns.append((box[..., 3] + length * cos + width * sin) / 2)
        columns.append((box[..., 4] + length * sin + width * cos) / 2)
    return np.stack(columns, axis=-1)


def _from_corners(one: Floats, other: Floats) -> Floats:
    """Return [...] the smallest distance of the first's corners to the other box."""
    away = corners(one) - other[..., None, :2]
    cos, sin = np.cos(other[..., 2:3]), np.sin(other[..., 2:3])
    along = np.abs(away[..., 0] * cos + away[..., 1] * sin) - other[..., 3:4] / 2
    across = np.abs(away[..., 1] * cos - away[..., 0] * sin) - other[..., 4:5] / 2
    outside = np.hypot(np.maximum(along, 0.0), np.maximum(across, 0.0))
    return np.asarray(outside.min(axis=-1))


LATEST = round(PET_HORIZON_S * 1e6 / FRAME_US)
"""Most frames between the first and the second at one place."""

STOPPED_MPS = 0.05
"""nuPlan's threshold of standing, for the ego and others alike."""

BEHIND_RAD = math.radians(150.0)
"""nuPlan: from this bearing on, the other's centre is behind the ego."""

AT_FAULT = (Contact.STANDING_PARTNER, Contact.FRONT)
"""Always the ego's fault; a contact at its side only outside of one lane."""

CHUNK = 256
"""Number of ego frames that are compared at once."""

Box = tuple[float, float, float, float, float]


@dataclass
class ConflictRecorder:
    """Keeps the boxes of all frames until the route is over."""

    _egos: list[tuple[float, ...]] = field(default_factory=list, init=False)
    _actors: list[list[tuple[float, ...]]] = field(default_factory=list, init=False)
    _kinds: dict[int, ActorKind] = field(default_factory=dict, init=False)

    def record(self, scene: Scene) -> None:
        """Keep one frame."""
        self._egos.append((*_box(scene.ego), scene.ego.speed_mps))
        rows = list[tuple[float, ...]]()
        for actor in scene.actors:
            self._kinds[actor.id] = actor.kind
            rows.append((*_box(actor), actor.speed_mps, actor.id))
        self._actors.append(rows)

    def result(self) -> ConflictRecord:
        """Return the distances, times and encounters of the frames kept so far."""
        # rows of all actors, each with the number of its frame
        counts = [len(rows) for rows in self._actors]
        frame = np.repeat(np.arange(len(counts)), counts)
        actors = np.array([row for rows in self._actors for row in rows]).reshape(-1, 7)
        egos = np.array(self._egos).reshape(-1, 6)
        # every actor against the ego of the same frame
        one, other = egos[frame], actors[:, :6]
        distance = gaps(one[:, :5], other[:, :5])
        velocity = _velocity(other) - _velocity(one)
        seconds = contact_times(one[:, :5], other[:, :5], velocity)
        # the smallest value of each frame
        nearest, soonest = np.full((2, len(counts)), np.inf)
        np.minimum.at(nearest, frame, distance)
        np.minimum.at(soonest, frame, seconds)
        # where both came to one place, of every actor that moved
        encounters = list[Encounter]()
        for number in np.unique(actors[:, 6]).astype(int).tolist():
            own = actors[:, 6] == number
            if actors[own, 5].any():
                kind = self._kinds[number].value
                for ego_at, at, angle in _same_place(egos, actors[own], frame[own]):
                    time_us = max(ego_at, at) * FRAME_US
                    pet_s = abs(ego_at - at) * FRAME_US / 1e6
                    what = number, kind, time_us, pet_s, round(angle, 3), ego_at < at
                    encounters.append(Encounter(*what))
        return ConflictRecord(
            _known(nearest, math.inf),
            _known(soonest, TTC_HORIZON_S),
            tuple(sorted(encounters, key=lambda each: (each.time_us, each.actor))),
        )


def contact_of(ego: Ego, actor: Actor) -> Contact:
    """Return the type of a contact, as in nuPlan's collision types.

    The source is no_ego_at_fault_collisions.py of nuplan-devkit 1.2; the reference
    point here is the ego's centre, nuPlan's is its rear axle.
    """
    if ego.speed_mps <= STOPPED_MPS:
        return Contact.STANDING_EGO
    if actor.speed_mps <= STOPPED_MPS:
        return Contact.STANDING_PARTNER
    bearing = math.atan2(actor.y - ego.y, actor.x - ego.x) - ego.heading
    if abs(math.remainder(bearing, math.tau)) > BEHIND_RAD:
        return Contact.REAR
    front = ego.length / 2
    x, y = ego.x + front * math.cos(ego.heading), ego.y + front * math.sin(ego.heading)
    bumper = np.array((x, y, ego.heading, 0.0, ego.width))
    return Contact.FRONT if overlaps(bumper, np.array(_box(actor))) else Contact.SIDE


def at_fault(contact: Contact, ego: Ego, roadmap: Roadmap) -> bool:
    """Return whether the ego could have prevented a contact, as nuPlan judges it.

    It could if it ran into something that stood, or hit with its front; or if it was
    hit at the side while not wholly in one lane (a lane and its successor count as
    one).
    """
    if contact is not Contact.SIDE:
        return contact in AT_FAULT
    four = corners(np.array(_box(ego)))
    driven = [lane for lane in roadmap.lanes if not lane.shoulder]
    for lane in driven:
        end = lane.centre[-1]
        led_to = (each for each in driven if np.allclose(each.centre[0], end))
        if not Roadmap((lane, *led_to)).outside_all(four).any():
            return False
    return True


def _same_place(
    egos: Floats, actor: Floats, frame: npt.NDArray[np.int64]
) -> list[tuple[int, int, float]]:
    """Return (frame of the ego, frame of the actor, angle) of the closest encounters.

    There are at most two: one at 30 degrees or more, one below. Boxes that overlap at
    two times share a place, so the fewest frames between such times are the PET.
    """
    # boxes farther apart than this cannot overlap
    reach = (np.hypot(*egos[0, 3:5]) + np.hypot(*actor[:, 3:5].T).max()) / 2
    best: dict[bool, tuple[int, int, int, float]] = {}
    for start in range(0, len(egos), CHUNK):
        # candidate pairs of frames, at most LATEST apart, where the ego comes at all
        ego = egos[start : start + CHUNK]
        low, high = ego[:, :2].min(axis=0) - reach, ego[:, :2].max(axis=0) + reach
        near = (frame >= start - LATEST) & (frame < start + CHUNK + LATEST)
        near &= ((actor[:, :2] >= low) & (actor[:, :2] <= high)).all(axis=1)
        if not near.any():
            continue
        other, when = actor[near], frame[near]
        apart = np.abs(start + np.arange(len(ego))[:, None] - when)
        away = np.hypot(*(ego[:, None, :2] - other[:, :2]).transpose(2, 0, 1))
        i, j = np.nonzero((apart <= LATEST) & (away <= reach))
        hit = overlaps(ego[i, :5], other[j, :5])
        i, j = i[hit], j[hit]
        # the closest pair of crossing paths, and of following ones
        turn = np.abs(np.angle(np.exp(1j * (ego[i, 2] - other[j, 2]))))
        for crossing in (True, False):
            kind = np.flatnonzero((turn >= CROSSING_RAD) == crossing)
            if len(kind):
                k = kind[np.argmin(apart[i[kind], j[kind]])]
                at = int(start + i[k]), int(when[j[k]])
                pair = abs(at[0] - at[1]), *at, float(turn[k])
                best[crossing] = min(best.get(crossing, pair), pair)
    return [pair[1:] for pair in best.values()]


def _box(one: Ego | Actor) -> Box:
    return one.x, one.y, one.heading, one.length, one.width


def _velocity(rows: Floats) -> Floats:
    heading, speed = rows[:, 2], rows[:, 5]
    return np.stack([speed * np.cos(heading), speed * np.sin(heading)], axis=1)


def _known(values: Floats, most: float) -> tuple[float | None, ...]:
    """Round to the millimetre or millisecond; None beyond the limit."""
    return tuple(
        round(value, 3) if math.isfinite(value) and value <= most else None
        for value in values.tolist()
    )
