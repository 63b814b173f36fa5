"""The world that a route unfolds in."""

from me2e_compress.simulator.scene import (
    INFRACTIONS,
    Event,
    EventKind,
)
from me2e_compress.simulator.world.privileged import (
    Intent,
    Phase,
    Privileged,
)
from me2e_compress.simulator.world.world import DT_US, EndReason, World

__all__ = [
    "DT_US",
    "INFRACTIONS",
    "EndReason",
    "Event",
    "EventKind",
    "Intent",
    "Phase",
    "Privileged",
    "World",
]
