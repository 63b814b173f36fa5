"""Events of a route: triggers, collisions and broken rules."""

from dataclasses import dataclass
from enum import StrEnum

from me2e_compress.simulator.scene import ActorKind


class EventKind(StrEnum):
    """Kinds of events."""

    TRIGGER = "trigger"
    """A scenario's script began to act."""
    COLLISION = "collision"
    """The ego with another body."""
    ACTOR_COLLISION = "actor_collision"
    """Two others; never in a well-written scenario."""
    STRUCK = "struck"
    """Another body with the standing ego; counts against nobody."""
    OUTSIDE_LANES = "outside_lanes"
    RED_LIGHT = "red_light"
    STOP_SIGN = "stop_sign"
    GIVE_WAY = "give_way"
    YIELD_EMERGENCY = "yield_emergency"


INFRACTIONS: frozenset[EventKind] = frozenset(EventKind) - {
    EventKind.TRIGGER,
    EventKind.ACTOR_COLLISION,
    EventKind.STRUCK,
}
"""Events that count against the driver."""


@dataclass(frozen=True, slots=True)
class Event:
    """One event.

    ``detail`` names the script, or says in words what happened; x and y (metres) are
    the ego's position. The actor is the other party, if any.
    """

    time_us: int
    kind: EventKind
    detail: str
    x: float
    y: float
    ego_speed_mps: float
    actor_id: int | None = None
    actor_kind: ActorKind | None = None
