"""An agent of the leaderboard by composition: no base class is needed to define one."""

from collections.abc import Callable
from typing import Any

from me2e_compress.agents.carla_interface import CarlaControl


class ForwardingAgent:
    """Answers for the agent that it holds.

    Whatever is not defined here is that agent's own: ``track``, ``sensor_interface``,
    ``hero_actor``, ``get_metric_info``, ``step``, ``metric_info``, ``save_path``. The
    leaderboard names the route before `setup`, where that agent is made: the route is
    kept for it.

    Args:
        carla_host: Of the simulator's server.
        carla_port: Of the simulator's server.
        debug: The leaderboard's own option.
    """

    _inner: Any = None

    def __init__(self, carla_host: str, carla_port: int, debug: bool = False) -> None:
        self._made_with = (carla_host, carla_port, debug)
        self._route: tuple[Any, Any] | None = None

    def adopt(self, make: Callable[[str, int, bool], Any]) -> None:
        """Make the agent to answer for, and name it the route."""
        inner = make(*self._made_with)
        if self._route is not None:
            inner.set_global_plan(*self._route)
        self._inner = inner

    def __getattr__(self, name: str) -> Any:
        """Return what the agent has under this name."""
        if self._inner is None:
            raise AttributeError(f"{type(self).__name__} has no {name} before setup")
        return getattr(self._inner, name)

    def __call__(self) -> CarlaControl:
        """Do one tick as the leaderboard's base class does: sensors, then run_step."""
        return self.tick_of(self)

    def tick_of(self, agent: "ForwardingAgent") -> CarlaControl:
        """Do one tick of the agent that holds this one, or of this one itself."""
        if isinstance(self._inner, ForwardingAgent):
            return self._inner.tick_of(agent)
        control: CarlaControl = type(self._inner).__call__(agent)
        return control

    def set_global_plan(
        self, global_plan_gps: Any, global_plan_world_coord: Any
    ) -> None:
        """Name the route, as GPS positions and as places of the world."""
        if self._inner is None:
            self._route = global_plan_gps, global_plan_world_coord
        else:
            self._inner.set_global_plan(global_plan_gps, global_plan_world_coord)

    @staticmethod
    def get_ros_version() -> int:
        """Say that it is no agent of ROS."""
        return -1
