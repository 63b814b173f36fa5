"""Infractions, by the keys of the CARLA leaderboard, and their penalties."""

from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import Annotated

from pydantic import ConfigDict, Field, with_config


class InfractionKind(StrEnum):
    """The keys of `infractions` in a leaderboard record, and `GIVE_WAY`, our own."""

    COLLISION_PEDESTRIAN = "collisions_pedestrian"
    COLLISION_VEHICLE = "collisions_vehicle"
    COLLISION_LAYOUT = "collisions_layout"
    RED_LIGHT = "red_light"
    STOP = "stop_infraction"
    GIVE_WAY = "give_way_infraction"
    """Crossing a give-way line close before priority traffic: CARLA has no such rule;
    it costs as much as a stop sign that was run."""
    OUTSIDE_ROUTE_LANES = "outside_route_lanes"
    MIN_SPEED = "min_speed_infractions"
    YIELD_TO_EMERGENCY_VEHICLE = "yield_emergency_vehicle_infractions"
    SCENARIO_TIMEOUT = "scenario_timeouts"
    ROUTE_DEVIATION = "route_dev"
    VEHICLE_BLOCKED = "vehicle_blocked"
    ROUTE_TIMEOUT = "route_timeout"


class Contact(StrEnum):
    """The kind of a contact: nuPlan's five types of collision."""

    STANDING_EGO = "the ego stood"
    STANDING_PARTNER = "the other stood"
    REAR = "struck from behind"
    FRONT = "with the ego's front"
    SIDE = "at the ego's side"


COLLISIONS = (
    InfractionKind.COLLISION_PEDESTRIAN,
    InfractionKind.COLLISION_VEHICLE,
    InfractionKind.COLLISION_LAYOUT,
)

PENALTY = MappingProxyType(
    {
        InfractionKind.COLLISION_PEDESTRIAN: 0.5,
        InfractionKind.COLLISION_VEHICLE: 0.6,
        InfractionKind.COLLISION_LAYOUT: 0.65,
        InfractionKind.RED_LIGHT: 0.7,
        InfractionKind.STOP: 0.8,
        InfractionKind.GIVE_WAY: 0.8,
        InfractionKind.SCENARIO_TIMEOUT: 0.7,
        InfractionKind.YIELD_TO_EMERGENCY_VEHICLE: 0.7,
        InfractionKind.MIN_SPEED: 1.0,
        InfractionKind.ROUTE_DEVIATION: 1.0,
        InfractionKind.VEHICLE_BLOCKED: 1.0,
        InfractionKind.ROUTE_TIMEOUT: 1.0,
    }
)
"""Factor per event: Bench2Drive 0.0.3, leaderboard/utils/statistics_manager.py.

Leaving the lanes has no fixed factor: it costs the share of the way driven outside.
GIVE_WAY is ours.
"""


@with_config(ConfigDict(allow_inf_nan=False, extra="forbid"))
@dataclass(frozen=True, slots=True)
class Infraction:
    """One infraction; values that a simulator does not report are None.

    Attributes:
        time_us: Simulated microseconds since the route began.
        x: Position of the ego, metres east.
        y: Metres north.
        detail: The other party or obstacle, in a few words.
        percent: For OUTSIDE_ROUTE_LANES, the share of the driven way spent outside; for
            MIN_SPEED, the ego's speed relative to the traffic's.
        contact: For collisions only.
        at_fault: Whether the ego could have prevented a collision, as nuPlan judges it.
    """

    kind: InfractionKind
    time_us: int | None
    x: float | None
    y: float | None
    detail: str
    percent: Annotated[float, Field(ge=0.0)] | None = None
    contact: Contact | None = None
    at_fault: bool | None = None
    ego_speed_mps: Annotated[float, Field(ge=0.0, le=1e9)] | None = None

    @property
    def factor(self) -> float:
        """Factor by which it multiplies the driving score."""
        if self.kind is InfractionKind.OUTSIDE_ROUTE_LANES:
            return 1.0 - (self.percent or 0.0) / 100.0
        return PENALTY[self.kind]
