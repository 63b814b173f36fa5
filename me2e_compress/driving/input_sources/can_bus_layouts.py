"""The CAN bus vector of 18 numbers, as different stacks fill it."""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from me2e_compress.driving.input_sources.base import InputSource, Observed
from me2e_compress.runtime.frames import Array


@dataclass(frozen=True)
class CanBus(InputSource):
    """UniAD's and VAD's 18 numbers: [18].

    ``bench2drive``, as in the contract, has the speed at 7, acceleration at 10 and
    angular rates at 13. ``nuscenes`` (BEVFormer's ``_get_can_bus_info``) has
    acceleration at 7, angular rates at 10 and the velocity at 13. Both have the
    position at 0, the quaternion at 3, the heading in radians at 16, in degrees at 17.

    Attributes:
        layout: Which layout.
        absolute: Absolute position and degrees, for a model that compares them with
            those of its last frame itself; else the change since the last decision.
    """

    name: ClassVar[str] = "can-bus"
    layout: Literal["bench2drive", "nuscenes"] = "bench2drive"
    absolute: bool = False

    def value(self, seen: Observed) -> Array:
        """Return float32 [18]."""
        given = seen.observation.can_bus
        bus = np.array(given, np.float32)
        if self.layout == "nuscenes":
            bus[7:10], bus[10:13] = given[10:13], given[13:16]
            bus[13:16] = given[7], 0.0, 0.0
        if self.absolute:
            bus[0:2] = seen.motion.x, seen.motion.y
            bus[17] = math.degrees(bus[16])
        return bus
