"""Leaderboard agents by composition, defined without their base class."""

from collections.abc import Callable
from typing import Any

from me2e_compress.agents.carla_interface import CarlaControl


class ForwardingAgent:
    """Forwards to the agent that it holds.

    Attributes that are not defined here are that agent's: ``track``,
    ``sensor_interface``, ``hero_actor``, ``get_metric_info``, ``step``,
    ``metric_info``, ``save_path``. The leaderboard names the route before it calls
    `setup`, which makes that agent, so the route is kept for it.
    """

    _inner: Any = None

    def __init__(self, carla_host: str, carla_port: int, debug: bool = False) -> None:
        self._made_with = (carla_host, carla_port, debug)
        self._route: tuple[Any, Any] | None = None

    def adopt(self, make: Callable[[str, int, bool], Any]) -> None:
        """Make the inner agent, and pass the route on to it."""
        inner = make(*self._made_with)
        if self._route is not None:
            inner.set_global_plan(*self._route)
        self._inner = inner

    def __getattr__(self, name: str) -> Any:
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
        """Keep the route, as GPS positions and as positions in the world."""
        if self._inner is None:
            self._route = global_plan_gps, global_plan_world_coord
        else:
            self._inner.set_global_plan(global_plan_gps, global_plan_world_coord)

    @staticmethod
    def get_ros_version() -> int:
        """Return -1: this is no agent of ROS."""
        return -1
