from typing import Any

import numpy.typing as npt
from highway_env.vehicle.kinematics import Vehicle

class IDMVehicle(Vehicle):
    COMFORT_ACC_MAX: float
    COMFORT_ACC_MIN: float
    DISTANCE_WANTED: float
    TIME_WANTED: float
    DELTA: float
    KP_LATERAL: float
    KP_HEADING: float
    TAU_PURSUIT: float
    MAX_STEERING_ANGLE: float
    target_speed: float
    target_lane_index: Any
    def __init__(
        self,
        road: Any,
        position: npt.ArrayLike,
        heading: float = ...,
        speed: float = ...,
        target_lane_index: Any = ...,
        target_speed: float | None = ...,
        route: Any = ...,
        enable_lane_change: bool = ...,
        timer: float | None = ...,
    ) -> None: ...
    def follow_road(self) -> Any: ...
    def acceleration(
        self, ego_vehicle: Any, front_vehicle: Any = ..., rear_vehicle: Any = ...
    ) -> float: ...
    def desired_gap(
        self, ego_vehicle: Any, front_vehicle: Any = ..., projected: bool = ...
    ) -> float: ...
