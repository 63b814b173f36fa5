from typing import Any

from highway_env.road.lane import AbstractLane

LaneIndex = tuple[str, str, int]

class RoadNetwork:
    graph: dict[str, dict[str, list[AbstractLane]]]
    def add_lane(self, _from: str, _to: str, lane: AbstractLane) -> None: ...
    def get_lane(self, index: LaneIndex) -> AbstractLane: ...
    def lanes_dict(self) -> dict[LaneIndex, AbstractLane]: ...
    def lanes_list(self) -> list[AbstractLane]: ...

class Road:
    network: RoadNetwork
    vehicles: list[Any]
    objects: list[Any]
    def __init__(
        self,
        network: RoadNetwork | None = ...,
        vehicles: list[Any] | None = ...,
        road_objects: list[Any] | None = ...,
        np_random: Any = ...,
        record_history: bool = ...,
        neighbour_vehicles_connected_lanes: bool = ...,
    ) -> None: ...
    def act(self) -> None: ...
    def step(self, dt: float) -> None: ...
    def neighbour_vehicles(
        self, vehicle: Any, lane_index: LaneIndex | None = ...
    ) -> tuple[Any, Any]: ...
