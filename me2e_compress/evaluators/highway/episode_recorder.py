"""Record a drive as the episode that is scored: frames, infractions, near misses."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from statistics import fmean

import numpy as np
import numpy.typing as npt

from me2e_compress.metrics.episode import (
    COLLISIONS,
    CROSSING_RAD,
    FRAME_US,
    PET_HORIZON_S,
    TTC_HORIZON_S,
    ConflictRecord,
    Contact,
    EgoFrame,
    Encounter,
    Ending,
    Episode,
    InferenceRecord,
    Infraction,
    InfractionKind,
)
from me2e_compress.simulator.plane_geometry import (
    Command,
    Roadmap,
    RoutePath,
    contact_times,
    corners,
    gaps,
    overlaps,
)
from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.scene import (
    Actor,
    ActorKind,
    Ego,
    Event,
    EventKind,
    Scene,
    box_of,
)
from me2e_compress.simulator.traffic.network import ANNOUNCED_M
from me2e_compress.simulator.world import World

NEAR_M = 50.0  # range of the vehicles whose speed the ego's is compared with

VEHICLES = (
    ActorKind.CAR,
    ActorKind.VAN,
    ActorKind.TRUCK,
    ActorKind.EMERGENCY,
    ActorKind.BICYCLE,
)
TURNS = (Command.LEFT, Command.RIGHT, Command.STRAIGHT)
LAYOUT = (ActorKind.CONE, ActorKind.BARRIER)
KINDS = {
    EventKind.RED_LIGHT: InfractionKind.RED_LIGHT,
    EventKind.STOP_SIGN: InfractionKind.STOP,
    EventKind.GIVE_WAY: InfractionKind.GIVE_WAY,
    EventKind.YIELD_EMERGENCY: InfractionKind.YIELD_TO_EMERGENCY_VEHICLE,
}
ENDINGS = {
    Ending.DEVIATION: InfractionKind.ROUTE_DEVIATION,
    Ending.BLOCKED: InfractionKind.VEHICLE_BLOCKED,
    Ending.TIMEOUT: InfractionKind.ROUTE_TIMEOUT,
}


@dataclass
class EpisodeRecorder:
    """Records one route: a frame every 50 ms, whatever the world's own step."""

    world: World
    frames: list[EgoFrame] = field(default_factory=list)
    decisions: list[InferenceRecord] = field(default_factory=list)
    scenes: list[Scene] = field(default_factory=list)

    def record(self, scene: Scene) -> None:
        """Record a frame if one is due."""
        if scene.time_us < len(self.frames) * FRAME_US:
            return
        ego = scene.ego
        near = [
            actor.speed_mps
            for actor in scene.actors
            if actor.kind in VEHICLES
            and math.hypot(actor.x - ego.x, actor.y - ego.y) <= NEAR_M
        ]
        frame = EgoFrame(
            time_us=scene.time_us,
            x=ego.x,
            y=ego.y,
            heading=ego.heading,
            speed_mps=ego.speed_mps,
            acceleration_mps2=ego.acceleration_mps2,
            lateral_acceleration_mps2=ego.lateral_acceleration_mps2,
            yaw_rate_radps=ego.yaw_rate_radps,
            steering_rad=ego.steering_rad,
            route_m=self.world.progress_m,
            traffic_speed_mps=fmean(near) if near else None,
        )
        self.frames.append(frame)
        self.scenes.append(scene)

    def episode(self, ending: Ending, failure: str | None = None) -> Episode:
        """Return the episode of the world's route."""
        world = self.world
        route, goal_m = world.route, world.path.goal_m
        completed = ending is Ending.COMPLETED
        return Episode(
            route=route.id,
            scenario=route.scenario,
            abilities=route.abilities,
            route_length_m=goal_m,
            completion_percent=100.0 if completed else completion_percent(world),
            ending=ending,
            failure=failure,
            infractions=_infractions(world, ending),
            frames=tuple(self.frames),
            decisions=tuple(self.decisions),
            junction_m=junction_m(world.path),
            conflicts=conflicts_of(self.scenes),
        )


def failed_episode(route: Route, completion_percent: float, failure: str) -> Episode:
    """Return the episode of a route whose process was lost with its record."""
    blank = EpisodeRecorder(World(route)).episode(Ending.POLICY_FAILED, failure)
    return replace(blank, completion_percent=completion_percent, conflicts=None)


def completion_percent(world: World) -> float:
    """Return the percentage of the route that was passed: 100 at the goal alone."""
    percent = round(100.0 * world.progress_m / world.path.goal_m, 2)
    return min(max(percent, 0.0), 99.99)


def junction_m(path: RoutePath) -> float | None:
    """Return metres to the first junction of a route, None if there is none."""
    for station, command in enumerate(path.commands):
        if station < path.goal_m and Command(int(command)) in TURNS:
            return station + ANNOUNCED_M
    return None


def _infractions(world: World, ending: Ending) -> tuple[Infraction, ...]:
    """Translate the world's events, and the end of the route, into infractions."""
    # Events that are infractions; a collision's kind is that of its partner
    infractions = list[Infraction]()
    for event in world.events:
        kind = KINDS.get(event.kind)
        if event.kind is EventKind.COLLISION:
            kind = InfractionKind.COLLISION_VEHICLE
            if event.actor_kind is ActorKind.PEDESTRIAN:
                kind = InfractionKind.COLLISION_PEDESTRIAN
            elif event.actor_kind in LAYOUT:
                kind = InfractionKind.COLLISION_LAYOUT
        if kind is not None:
            infractions.append(_infraction(kind, event, world))
    # All leaving of lanes is one infraction, placed where it began
    left = next((e for e in world.events if e.kind is EventKind.OUTSIDE_LANES), None)
    if left is not None:
        outside_m = world.outside_distance_m
        passed_m = max(world.progress_m, outside_m, 1e-9)
        percent = min(100.0, 100.0 * outside_m / passed_m)
        kind, detail = InfractionKind.OUTSIDE_ROUTE_LANES, f"{outside_m:.2f} m"
        infractions.append(
            Infraction(kind, left.time_us, left.x, left.y, detail, percent)
        )
    # The end of the route, unless it was reached
    if ending in ENDINGS:
        ego, kind = world.scene().ego, ENDINGS[ending]
        infractions.append(Infraction(kind, world.time_us, ego.x, ego.y, ending.value))
    return tuple(sorted(infractions, key=lambda infraction: infraction.time_us or 0))


def _infraction(kind: InfractionKind, event: Event, world: World) -> Infraction:
    """Return an infraction; of a collision with its contact, and whose fault it was."""
    partner = "" if event.actor_kind is None else f"{event.actor_kind.value} "
    number = "" if event.actor_id is None else f"{event.actor_id}"
    detail = f"{partner}{number}".strip() or event.detail
    infraction = Infraction(
        kind, event.time_us, event.x, event.y, detail, ego_speed_mps=event.ego_speed_mps
    )
    # Contact and fault follow from the scene of the collision
    if kind in COLLISIONS:
        scene = world.collided[event.time_us]
        for actor in scene.actors:
            if actor.id == event.actor_id:
                contact = contact_of(scene.ego, actor)
                fault = at_fault(contact, scene.ego, world.roadmap)
                return replace(infraction, contact=contact, at_fault=fault)
    return infraction


# Distance, TTC and PET of a drive, and who was at fault in a collision: computed once,
# after the route, over all its frames, in about 1 % of the time of driving it.

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
                met = number, kind, time_us, pet_s, round(angle, 3), ego_at < at
                encounters.append(Encounter(*met))
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
    hit at the side while not wholly in one lane.
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
