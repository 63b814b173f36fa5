from typing import Any

import numpy as np
import numpy.typing as npt

class RoadObject:
    LENGTH: float
    WIDTH: float
    road: Any
    position: npt.NDArray[np.float64]
    heading: float
    speed: float
    diagonal: float
    lane_index: Any
    def __init__(
        self,
        road: Any,
        position: npt.ArrayLike,
        heading: float = ...,
        speed: float = ...,
    ) -> None: ...
    def __getattr__(self, name: str) -> Any: ...

class Obstacle(RoadObject): ...
