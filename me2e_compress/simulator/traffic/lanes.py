"""Coordinates of many points in all lanes at once.

highway-env asks every lane about every vehicle one by one, which takes most of its
time; straight and circular lanes, the only ones we build, allow one vectorised
answer.
"""

import numpy as np
import numpy.typing as npt
from highway_env.road.lane import CircularLane, StraightLane
from highway_env.road.road import RoadNetwork

from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.traffic.network import LaneIndex


class LaneTable:
    """All lanes of a network as arrays (highway-env's y-down plane)."""

    def __init__(self, network: RoadNetwork) -> None:
        lanes = network.lanes_dict()
        self.column: dict[LaneIndex, int] = {key: i for i, key in enumerate(lanes)}
        self.length: Floats = np.array([lane.length for lane in lanes.values()])
        # straight and circular lanes apart, each as arrays
        straight, circular = list[int](), list[int]()
        for i, lane in enumerate(lanes.values()):
            (straight if isinstance(lane, StraightLane) else circular).append(i)
        self._straight: npt.NDArray[np.int64] = np.array(straight, dtype=np.int64)
        self._circular: npt.NDArray[np.int64] = np.array(circular, dtype=np.int64)
        values = list(lanes.values())
        lines = [lane for lane in values if isinstance(lane, StraightLane)]
        self._start = np.array([lane.start for lane in lines]).reshape(-1, 2)
        self._along = np.array([lane.direction for lane in lines]).reshape(-1, 2)
        arcs = [lane for lane in values if isinstance(lane, CircularLane)]
        self._centre = np.array([lane.center for lane in arcs]).reshape(-1, 2)
        self._radius = np.array([lane.radius for lane in arcs])
        self._phase = np.array([lane.start_phase for lane in arcs])
        self._sense = np.array([lane.direction for lane in arcs])

    def coordinates(self, points: Floats) -> tuple[Floats, Floats]:
        """Return arc lengths and lateral offsets (highway-env's sign) in all lanes.

        ``points`` is [N, 2] in highway-env's plane; both results are [N, lanes].
        """
        s = np.empty((len(points), len(self.length)))
        r = np.empty_like(s)
        if len(self._straight):
            dx, dy = (points[:, i, None] - self._start[:, i] for i in (0, 1))
            ax, ay = self._along[:, 0], self._along[:, 1]
            s[:, self._straight] = dx * ax + dy * ay
            r[:, self._straight] = dy * ax - dx * ay
        if len(self._circular):
            dx, dy = (points[:, i, None] - self._centre[:, i] for i in (0, 1))
            turn = np.arctan2(dy, dx) - self._phase
            turn = (turn + np.pi) % (2 * np.pi) - np.pi
            s[:, self._circular] = self._sense * turn * self._radius
            away = np.hypot(dx, dy)
            r[:, self._circular] = self._sense * (self._radius - away)
        return s, r

    def headings(self, s: Floats) -> Floats:
        """Return headings [N, lanes] (highway-env's sign) at arc lengths [N, lanes]."""
        angles = np.empty_like(s)
        along = np.arctan2(self._along[:, 1], self._along[:, 0])
        angles[:, self._straight] = along
        if len(self._circular):
            turned = s[:, self._circular] / self._radius + np.pi / 2
            angles[:, self._circular] = self._phase + self._sense * turned
        return angles
