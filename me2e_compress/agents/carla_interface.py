"""The parts of CARLA and of its leaderboard that agents use.

Both are imported on first use, so that naming an agent needs neither.
"""

import importlib
from collections.abc import Mapping
from types import ModuleType
from typing import Any, Protocol, TypeAlias, TypeVar

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
