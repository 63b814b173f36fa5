"""The ego's past poses on this route, one per decision."""

from bisect import bisect_right
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from me2e_compress.driving.ego_kinematics import EgoKinematics

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
