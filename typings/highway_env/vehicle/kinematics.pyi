from typing import Any

from highway_env.vehicle.objects import RoadObject

class Vehicle(RoadObject):
    action: dict[str, float]
    def act(self, action: Any = ...) -> None: ...
    def step(self, dt: float) -> None: ...
