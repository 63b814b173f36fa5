"""Distance, TTC and PET of a drive, and who was at fault in a collision.

They are computed once, after the route, over all its frames: about 1 % of the time that
driving it takes.
"""

import math
from collections.abc import Sequence

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
from me2e_compress.simulator.plane_geometry import (
    Roadmap,
    contact_times,
    corners,
    gaps,
    overlaps,
)
from me2e_compress.simulator.scene import Actor, Ego, Scene, box_of

Floats = npt.NDArray[np.float64]

# Most frames between the first and the second at one place
LATEST = round(PET_HORIZON_S * 1e6 / FRAME_US)

STOPPED_MPS = 0.05  # nuPlan's threshold of standing, for the ego and others alike

# nuPlan: from this bearing on, the other's centre is behind the ego
BEHIND_RAD = math.radians(150.0)

# Always the ego's fault; a contact at its side only outside of one lane
AT_FAULT = (Contact.STANDING_PARTNER, Contact.FRONT)

CHUNK = 256  # number of ego frames that are compared at once


def conflicts_of(scenes: Sequence[Scene]) -> ConflictRecord:
    """Return distances, times and encounters of a route's frames, 50 ms apart."""
    # Rows of all actors, each with the number of its frame
    kinds = {actor.id: actor.kind for scene in scenes for actor in scene.actors}
    counts = [len(scene.actors) for scene in scenes]
    frame = np.repeat(np.arange(len(counts)), counts)
    rows = [(*box_of(a), a.speed_mps, a.id) for scene in scenes for a in scene.actors]
    actors = np.array(rows).reshape(-1, 7)
    # Columns: x, y, heading, length, width, speed, and the actor's number
    boxes = [(*box_of(scene.ego), scene.ego.speed_mps) for scene in scenes]
    egos = np.array(boxes).reshape(-1, 6)
    # Compare every actor with the ego of the same frame
    one, other = egos[frame], actors[:, :6]  # (rows, 6) each
    distance = gaps(one[:, :5], other[:, :5])
    velocities = [
        row[:, 5:] * np.stack([np.cos(row[:, 2]), np.sin(row[:, 2])], axis=1)
        for row in (one, other)
    ]
    seconds = contact_times(one[:, :5], other[:, :5], velocities[1] - velocities[0])
    # Find the smallest value of each frame
    nearest, soonest = np.full((2, len(counts)), np.inf)
    np.minimum.at(nearest, frame, distance)
    np.minimum.at(soonest, frame, seconds)
    # Find where the ego and an actor that moved came to one place
    encounters = list[Encounter]()
    for number in np.unique(actors[:, 6]).astype(int).tolist():
        own = actors[:, 6] == number
        if actors[own, 5].any():
            kind = kinds[number].value
            for ego_at, at, angle in _same_place(egos, actors[own], frame[own]):
                time_us = max(ego_at, at) * FRAME_US
                pet_s = abs(ego_at - at) * FRAME_US / 1e6
                encounters.append(
                    Encounter(
                        number, kind, time_us, pet_s, round(angle, 3), ego_at < at
                    )
                )
    encounters.sort(key=lambda met: (met.time_us, met.actor))
    return ConflictRecord(
        _known(nearest, math.inf), _known(soonest, TTC_HORIZON_S), tuple(encounters)
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
    return Contact.FRONT if overlaps(bumper, np.array(box_of(actor))) else Contact.SIDE


def at_fault(contact: Contact, ego: Ego, roadmap: Roadmap) -> bool:
    """Return whether the ego could have prevented a contact, as nuPlan judges it.

    It could if it ran into something that stood, or hit with its front; or if it was
    hit at the side while not wholly in one lane (a lane and its successor count as
    one).
    """
    if contact is not Contact.SIDE:
        return contact in AT_FAULT
    four = corners(np.array(box_of(ego)))
    driven = [lane for lane in roadmap.lanes if not lane.shoulder]
    for lane in driven:
        end = lane.centre[-1]
        following = (other for other in driven if np.allclose(other.centre[0], end))
        if not Roadmap((lane, *following)).outside_all(four).any():
            return False
    return True


def _same_place(
    egos: Floats, actor: Floats, frame: npt.NDArray[np.int64]
) -> list[tuple[int, int, float]]:
    """Return (frame of the ego, frame of the actor, angle) of the closest encounters.

    There are at most two: one at 30 degrees or more, one below. Boxes that overlap at
    two times share a place, so the fewest frames between such times are the PET.
    """
    # Boxes farther apart than this cannot overlap
    reach = (np.hypot(*egos[0, 3:5]) + np.hypot(*actor[:, 3:5].T).max()) / 2
    best: dict[bool, tuple[int, int, int, float]] = {}
    for start in range(0, len(egos), CHUNK):
        # Candidate pairs of frames, at most LATEST apart, where the ego comes at all
        ego = egos[start : start + CHUNK]
        low, high = ego[:, :2].min(axis=0) - reach, ego[:, :2].max(axis=0) + reach
        near = (frame >= start - LATEST) & (frame < start + CHUNK + LATEST)
        near &= ((actor[:, :2] >= low) & (actor[:, :2] <= high)).all(axis=1)
        if not near.any():
            continue
        # Pairs (i, j) of an ego frame and an actor frame whose boxes overlap
        other, when = actor[near], frame[near]
        apart = np.abs(start + np.arange(len(ego))[:, None] - when)
        away = np.hypot(*(ego[:, None, :2] - other[:, :2]).transpose(2, 0, 1))
        i, j = np.nonzero((apart <= LATEST) & (away <= reach))
        hit = overlaps(ego[i, :5], other[j, :5])
        i, j = i[hit], j[hit]
        # The closest pair of crossing paths, and of following ones
        turn = np.abs(np.angle(np.exp(1j * (ego[i, 2] - other[j, 2]))))
        for crossing in (True, False):
            kind = np.flatnonzero((turn >= CROSSING_RAD) == crossing)
            if len(kind):
                k = kind[np.argmin(apart[i[kind], j[kind]])]
                at = int(start + i[k]), int(when[j[k]])
                pair = abs(at[0] - at[1]), *at, float(turn[k])
                best[crossing] = min(best.get(crossing, pair), pair)
    return [pair[1:] for pair in best.values()]


def _known(values: Floats, most: float) -> tuple[float | None, ...]:
    """Round to the millimetre or millisecond; None beyond the limit."""
    known = (values <= most) & np.isfinite(values)
    pairs = zip(values.tolist(), known.tolist(), strict=True)
    return tuple(round(value, 3) if finite else None for value, finite in pairs)
