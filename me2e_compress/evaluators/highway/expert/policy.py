"""The expert as a policy."""

from dataclasses import dataclass, field

from me2e_compress.driving.contract import Observation, Plan, RouteInfo
from me2e_compress.evaluators.highway.expert.deciding import (
    ExpertDecision,
    Memory,
    decide,
)
from me2e_compress.evaluators.highway.expert.speed import ceiling
from me2e_compress.evaluators.highway.observe import scene_and_world
from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.scene import RoutePath


@dataclass
class Expert:
    """Drives by `decide`, remembering its target lane and the signs it obeyed.

    Args:
        last: The last decision, for labels and pictures; None before the first.
    """

    needs_images: bool = field(default=False, init=False)
    privileged: bool = field(default=True, init=False)
    last: ExpertDecision | None = field(default=None, init=False)
    _path: RoutePath | None = field(default=None, init=False, repr=False)
    _top: Floats | None = field(default=None, init=False, repr=False)

    def reset(self, route: RouteInfo) -> None:
        """Forget the last route."""
        self.last = self._path = self._top = None

    def plan(self, observation: Observation) -> Plan:
        """Return six waypoints [6, 2], metres in the ego frame, every 0.5 s."""
        scene, world = scene_and_world(observation, "driver expert")
        if self._top is None or self._path is not world.path:
            self._path, self._top = world.path, ceiling(world.path)
        memory = Memory() if self.last is None else self.last.memory
        self.last = decide(scene, world.privileged(), world.path, self._top, memory)
        return self.last.waypoints
