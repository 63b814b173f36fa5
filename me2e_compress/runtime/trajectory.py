"""Timed waypoints of a planner, of any number and spacing."""

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from me2e_compress.errors import EvaluationError

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False, slots=True)
class Trajectory:
    """The planned path of the ego.

    Attributes:
        points: [n, 2] metres, n at least 1; x forward, y left in the ego frame of the
            observation.
        times_s: [n] seconds after the observation, above 0 and increasing.

    Raises:
        EvaluationError: another shape, or times that do not increase from above 0.
    """

    points: npt.NDArray[np.floating]
    times_s: npt.NDArray[np.floating]

    def __post_init__(self) -> None:
        """Check shapes and times; the driver checks that the points are finite."""
        shape, times = list(self.points.shape), self.times_s
        if len(shape) != 2 or shape[1] != 2 or not shape[0]:
            raise EvaluationError(f"waypoints have shape {shape}, they must be [n, 2]")
        if times.shape != (shape[0],):
            raise EvaluationError(
                f"{shape[0]} waypoints and times of shape {list(times.shape)}"
            )
        if not (np.diff(times, prepend=0.0) > 0).all():
            raise EvaluationError("times of waypoints must increase from above 0")

    @classmethod
    def ahead(
        cls, points: npt.NDArray[np.floating], times_s: npt.NDArray[np.floating]
    ) -> Self:
        """Build a trajectory of the waypoints after the observation."""
        if not (times_s > 0).any():
            raise EvaluationError("no waypoint lies after the observation")
        return cls(points[times_s > 0], times_s[times_s > 0])

    def at(self, times_s: npt.NDArray[np.floating]) -> Floats:
        """Return the positions [m, 2] at other times [m] from 0 on.

        They are interpolated linearly, from the ego at 0 s; after the last waypoint
        they continue at the last velocity.
        """
        times = np.concatenate([[0.0], self.times_s])
        points = np.vstack([np.zeros((1, 2)), self.points])
        velocity = (points[-1] - points[-2]) / (times[-1] - times[-2])
        asked = np.asarray(times_s, np.float64)
        x, y = (np.interp(asked, times, column) for column in points.T)
        beyond = np.maximum(asked - times[-1], 0.0)
        places: Floats = np.stack([x, y], axis=1) + beyond[:, None] * velocity
        return places
