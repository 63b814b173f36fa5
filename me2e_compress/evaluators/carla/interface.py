"""CARLA and its leaderboard as agents see them; agents by composition."""

import importlib
import math
from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Any, Protocol, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from me2e_compress.errors import EvaluationError, MissingPackageError

SensorData: TypeAlias = Mapping[str, tuple[int, Any]]
"""The data of one tick, by the sensor's id: (frame, data)."""
SensorSpecs: TypeAlias = list[dict[str, Any]]
"""The sensors that an agent asks the leaderboard to mount."""

AGENT_MODULE = "leaderboard.autoagents.autonomous_agent"


class CarlaControl(Protocol):
    """A ``carla.VehicleControl``."""

    throttle: float
    steer: float
    brake: float
    hand_brake: bool
    reverse: bool
    manual_gear_shift: bool
    gear: int


CONTROL_FIELDS = tuple(CarlaControl.__annotations__)
ControlT = TypeVar("ControlT", bound=CarlaControl)


def copy_of(control: ControlT) -> ControlT:
    """Return an equal control, field by field: CARLA's cannot be copied or pickled."""
    copy = type(control)()
    for name in CONTROL_FIELDS:
        setattr(copy, name, getattr(control, name))
    return copy


def carla_control(throttle: float, steer: float, brake: float) -> CarlaControl:
    """Build a control: throttle and brake 0 to 1, steer -1 (left) to 1 (right)."""
    control: CarlaControl = carla_module().VehicleControl()
    control.throttle, control.steer, control.brake = throttle, steer, brake
    return control


def carla_module() -> ModuleType:
    """Import CARLA's client; raises MissingPackageError if it is not installed."""
    try:
        return importlib.import_module("carla")
    except ModuleNotFoundError as error:
        if error.name != "carla":
            raise
        raise MissingPackageError("carla") from error


def autonomous_agent_class() -> type:
    """Import the leaderboard's base class of agents."""
    carla_module()
    try:
        module = importlib.import_module(AGENT_MODULE)
    except ModuleNotFoundError as error:
        if error.name is None or not AGENT_MODULE.startswith(error.name):
            raise
        raise EvaluationError(
            f"{AGENT_MODULE} is not importable: put the folders leaderboard and "
            "scenario_runner on PYTHONPATH"
        ) from error
    found: type = module.AutonomousAgent
    return found


KINDS = ("vehicle.", "walker.pedestrian.")
"""Beginnings of CARLA's type ids."""


def agents_around(hero: Any) -> npt.NDArray[np.float64] | None:
    """Return positions [N, 2] of other road users, occluded or not.

    Metres in the ego frame, x forward, y left; None without ``hero``, the ego's
    ``carla.Actor``, which not every leaderboard gives.
    """
    if hero is None:
        return None
    at = hero.get_transform()
    yaw = math.radians(at.rotation.yaw)
    others = (
        each.get_location()
        for each in hero.get_world().get_actors()
        if each.type_id.startswith(KINDS) and each.id != hero.id
    )
    away = [(place.x - at.location.x, place.y - at.location.y) for place in others]
    # CARLA's y points to the right, and so does its yaw
    turn = [[math.cos(yaw), math.sin(yaw)], [math.sin(yaw), -math.cos(yaw)]]
    return np.array(away, np.float64).reshape(-1, 2) @ turn


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
