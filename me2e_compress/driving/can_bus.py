"""The CAN bus of an observation: the ego's motion and its recent change."""

import math

import numpy as np
import numpy.typing as npt

from me2e_compress.driving.contract import CAN_BUS_SIZE
from me2e_compress.driving.ego_kinematics import EgoKinematics


def can_bus_between(
    now: EgoKinematics, last: EgoKinematics | None
) -> npt.NDArray[np.float32]:
    """Return float32 [18], laid out as in `Observation`.

    ``last`` is the state at the previous decision, None at the first.
    """
    bus = np.zeros(CAN_BUS_SIZE, np.float64)
    # quaternion of the heading, then motion
    bus[3], bus[6] = math.cos(now.heading / 2), math.sin(now.heading / 2)
    bus[7] = now.speed_mps
    bus[10:13] = now.acceleration_mps2
    bus[13:16] = now.angular_velocity_radps
    bus[16] = now.heading % (2 * math.pi)
    # what changed since the last decision
    if last is not None:
        bus[0:2] = now.x - last.x, now.y - last.y
        turned = math.remainder(now.heading - last.heading, 2 * math.pi)
        bus[17] = math.degrees(turned)
    return bus.astype(np.float32)
