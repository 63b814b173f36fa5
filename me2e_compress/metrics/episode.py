"""An episode: the record of one route, driven to its end, and its infractions."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any

from pydantic import ConfigDict, Field, TypeAdapter, with_config

__all__ = [
    "FRAME_US",
    "ConflictRecord",
    "Contact",
    "EgoFrame",
    "Ending",
    "Episode",
    "Given",
    "InferenceRecord",
    "Infraction",
    "InfractionKind",
]


class InfractionKind(StrEnum):
    """The keys of `infractions` in a leaderboard record, and `GIVE_WAY`, our own."""

    COLLISION_PEDESTRIAN = "collisions_pedestrian"
    COLLISION_VEHICLE = "collisions_vehicle"
    COLLISION_LAYOUT = "collisions_layout"
    RED_LIGHT = "red_light"
    STOP = "stop_infraction"
    # Crossing a give-way line close before priority traffic: CARLA has no such rule; it
    # costs as much as a stop sign that was run
    GIVE_WAY = "give_way_infraction"
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

# Factor per event: Bench2Drive 0.0.3, leaderboard/utils/statistics_manager.py. Leaving
# the lanes has no fixed factor: it costs the share of the way driven outside. GIVE_WAY
# is ours.
PENALTY: Mapping[InfractionKind, float] = {
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


_STRICT = ConfigDict(allow_inf_nan=False, extra="forbid")

# The largest magnitude of a number on file: beyond, squares and sums overflow
LARGEST = 1e9

# A distance, duration or speed that is finite and not negative
Quantity = Annotated[float, Field(ge=0.0, le=LARGEST)]


@with_config(_STRICT)
@dataclass(frozen=True, slots=True)
class Infraction:
    """One infraction; values that a simulator does not report are None."""

    kind: InfractionKind
    time_us: int | None  # simulated microseconds since the route began
    x: float | None  # position of the ego, metres east
    y: float | None  # metres north
    detail: str  # the other party or obstacle, in a few words
    # For OUTSIDE_ROUTE_LANES, the share of the driven way spent outside; for MIN_SPEED,
    # the ego's speed relative to the traffic's
    percent: Annotated[float, Field(ge=0.0)] | None = None
    contact: Contact | None = None  # for collisions only
    # Whether the ego could have prevented a collision, as nuPlan judges it
    at_fault: bool | None = None
    ego_speed_mps: Quantity | None = None

    @property
    def factor(self) -> float:
        """Factor by which it multiplies the driving score."""
        if self.kind is InfractionKind.OUTSIDE_ROUTE_LANES:
            return 1.0 - (self.percent or 0.0) / 100.0
        return PENALTY[self.kind]


# Record of how close an episode came to a collision.

# A contact later than this is not written down: our choice, far beyond every threshold
# in use (0.95 s in nuPlan, 1.5 s in SSAM, 4 s in driver assistance)
TTC_HORIZON_S = 10.0

PET_HORIZON_S = 5.0  # longest post-encroachment time: SSAM's default (FHWA-HRT-08-051)

# From this angle between headings paths cross or merge; below it one follows the other,
# and the time between them is a headway: SSAM's rear-end angle
CROSSING_RAD = math.radians(30.0)


@with_config(_STRICT)
@dataclass(frozen=True, slots=True)
class Encounter:
    """The ego and a moving actor were at the same place, one after the other."""

    actor: int
    kind: str
    time_us: int  # when the second of the two arrived
    # Post-encroachment time (Allen, Shin and Cooper 1978; SAE J2944): from when the
    # first left a place until the second arrived, the least of all places
    pet_s: Quantity
    # Between their headings: 0 is the same direction, pi oncoming
    angle_rad: Annotated[float, Field(ge=0.0, le=3.15)]
    ego_first: bool


@with_config(_STRICT)
@dataclass(frozen=True, slots=True)
class ConflictRecord:
    """Distances and times to collision for each frame, and all encounters."""

    # Metres between the outlines of ego and nearest actor; None if there is none
    nearest_m: tuple[Quantity | None, ...]
    # Time to collision: seconds until the ego's box and any actor's touch if both keep
    # heading and speed; None above `TTC_HORIZON_S`. As in nuPlan and NAVSIM, but exact,
    # and including actors from behind.
    ttc_s: tuple[Quantity | None, ...]
    # In order of time; an actor has at most one with crossing or merging paths and one
    # in the ego's direction
    encounters: tuple[Encounter, ...]


# Microseconds between two frames: the simulators of the benchmarks run at 20 Hz
FRAME_US = 50_000

Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]


class Ending(StrEnum):
    """The reason why a route ended."""

    COMPLETED = "completed"
    COLLISION = "collision"
    DEVIATION = "deviated from the route"
    BLOCKED = "blocked"
    TIMEOUT = "timed out"
    POLICY_FAILED = "policy failed"
    SIMULATOR_FAILED = "simulator failed"


# Endings that are not the driver's driving
FAILURES = (Ending.POLICY_FAILED, Ending.SIMULATOR_FAILED)


@with_config(_STRICT)
@dataclass(frozen=True, slots=True)
class EgoFrame:
    """The ego at one instant, every 50 ms, in SI units.

    x points east, y north; angles are counter-clockwise from east.
    """

    time_us: int  # simulated microseconds since the route began
    x: Number
    y: Number
    heading: Number
    speed_mps: Number
    acceleration_mps2: Number
    lateral_acceleration_mps2: Number
    yaw_rate_radps: Number
    steering_rad: Number | None  # of the front wheels, left positive, if reported
    route_m: Number  # metres of the route passed; never decreases
    traffic_speed_mps: Number | None  # mean of nearby vehicles, if there are any
    # Norm of the acceleration in the plane if a simulator recorded it separately; None
    # if it follows from the two components
    acceleration_norm_mps2: Number | None = None


@with_config(_STRICT)
@dataclass(frozen=True, slots=True)
class InferenceRecord:
    """One inference: when its observation was taken and how long it took."""

    time_us: int
    latency_us: int


@with_config(_STRICT)
@dataclass(frozen=True, slots=True)
class Given:
    """What a simulator itself reported about a route, kept apart from computed values.

    ``status`` is in the simulator's words, such as ``Failed - Agent got blocked``;
    ``penalty`` is the product of all factors, ``composed_percent`` the driving score.
    """

    status: str
    completion_percent: Number
    penalty: Number
    composed_percent: Number


@with_config(_STRICT)
@dataclass(frozen=True, slots=True)
class Episode:
    """One route driven to its end."""

    route: str
    scenario: str
    abilities: tuple[str, ...]  # one or two of Bench2Drive's five
    route_length_m: Quantity
    completion_percent: Annotated[float, Field(ge=0.0, le=100.0)]
    ending: Ending
    failure: str | None  # how the policy failed, if that ended the route
    infractions: tuple[Infraction, ...]  # in order of time
    frames: tuple[EgoFrame, ...]
    decisions: tuple[InferenceRecord, ...]  # one record per inference
    junction_m: Number | None = None  # metres to the first junction, if there is one
    # Ego speed over traffic speed at the check points, if the simulator reported them;
    # None if they follow from the frames
    speed_ratios_percent: tuple[Number, ...] | None = None
    given: Given | None = None  # scores of the simulator itself, if there are any
    conflicts: ConflictRecord | None = None  # None if it was not recorded

    @property
    def succeeded(self) -> bool:
        """Whether the whole route was driven without infractions other than low speed.

        A route must also end at its goal, whatever its completion: Bench2Drive asks for
        status Completed or Perfect (merge_route_json.py).
        """
        whole = self.ending is Ending.COMPLETED and self.completion_percent >= 100.0
        kinds = {infraction.kind for infraction in self.infractions}
        return whole and kinds <= {InfractionKind.MIN_SPEED}

    def to_json(self) -> dict[str, Any]:
        """Return plain objects; frames and decisions are stored column by column."""
        bare = dataclasses.replace(self, frames=(), decisions=())
        record: dict[str, Any] = _EPISODE.dump_python(bare, mode="json")
        for kind, rows in ((EgoFrame, self.frames), (InferenceRecord, self.decisions)):
            names = [field.name for field in dataclasses.fields(kind)]
            columns = {name: [getattr(row, name) for row in rows] for name in names}
            record["frames" if kind is EgoFrame else "decisions"] = columns
        return record

    @classmethod
    def from_json(cls, record: dict[str, Any]) -> "Episode":
        """Return the episode that `to_json` was called on.

        Raises:
            ValueError: If anything is missing, unknown, of another type or not finite.
        """
        record = dict(record)
        for name in ("frames", "decisions"):
            columns = record.get(name, {})
            lists = columns.values() if isinstance(columns, dict) else ()
            if not isinstance(columns, dict) or set(map(type, lists)) - {list}:
                raise ValueError(f"{name} are not stored as columns")
            if len(set(map(len, lists))) > 1:
                raise ValueError(f"the columns of {name} differ in length")
            rows = zip(*lists, strict=True)
            record[name] = tuple(dict(zip(columns, row, strict=True)) for row in rows)
        return _EPISODE.validate_python(record)


_EPISODE = TypeAdapter(Episode)
