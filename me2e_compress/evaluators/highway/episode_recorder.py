"""Record a drive as the episode that is scored."""

import math
from dataclasses import dataclass, field, replace
from statistics import fmean

from me2e_compress.evaluators.highway.conflict_recorder import (
    at_fault,
    conflicts_of,
    contact_of,
)
from me2e_compress.metrics.episode import (
    COLLISIONS,
    FRAME_US,
    EgoFrame,
    Ending,
    Episode,
    InferenceRecord,
    Infraction,
    InfractionKind,
)
from me2e_compress.simulator.plane_geometry import Command, RoutePath
from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.scene import ActorKind, Event, EventKind, Scene
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
    """Return how much of the route was passed while its goal is not reached.

    It has two digits, as in the leaderboard; only reaching the goal makes it 100.
    """
    percent = round(100.0 * world.progress_m / world.path.goal_m, 2)
    return min(max(percent, 0.0), 99.99)


def junction_m(path: RoutePath) -> float | None:
    """Return where the first junction of a route begins, None if there is none.

    Its command is announced 20 m ahead.
    """
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
        kind,
        event.time_us,
        event.x,
        event.y,
        detail,
        ego_speed_mps=event.ego_speed_mps,
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
