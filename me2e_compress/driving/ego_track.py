"""The ego's motion since the last decision, and its poses on this route."""

import math
from bisect import bisect_right
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from me2e_compress.driving.contract import CAN_BUS_SIZE, EgoKinematics


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


Floats = npt.NDArray[np.float64]


@dataclass
class EgoTrack:
    """Poses and speeds by time, since the route began."""

    decisions: int = field(default=0, init=False)
    _times_us: list[int] = field(default_factory=list, init=False)
    _states: list[tuple[float, float, float, float]] = field(
        default_factory=list, init=False
    )

    def note(self, time_us: int, motion: EgoKinematics | None) -> None:
        """Count a decision, and keep the ego's pose if it is known."""
        self.decisions += 1
        if motion is not None:
            state = (motion.x, motion.y, motion.heading, motion.speed_mps)
            self._times_us.append(time_us)
            self._states.append(state)

    def clear(self) -> None:
        """Begin a route."""
        self.decisions = 0
        self._times_us.clear()
        self._states.clear()

    def at(self, times_us: npt.NDArray[np.floating]) -> Floats:
        """Return [n, 4] of n times: x, y (m), heading (rad, unwrapped), speed (m/s).

        Interpolates between decisions, constant before the first; needs one pose or
        more.
        """
        # what is older than all of them is not looked at: a route has thousands
        first = max(0, bisect_right(self._times_us, float(np.min(times_us))) - 1)
        states = np.array(self._states[first:], np.float64)
        states[:, 2] = np.unwrap(states[:, 2])
        known = self._times_us[first:]
        columns = [np.interp(times_us, known, each) for each in states.T]
        return np.stack(columns, axis=1)
