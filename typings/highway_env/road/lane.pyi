from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

class LineType:
    NONE: int
    STRIPED: int
    CONTINUOUS: int
    CONTINUOUS_LINE: int

class AbstractLane:
    length: float
    width: float
    speed_limit: float
    line_types: Sequence[int]
    def position(
        self, longitudinal: float, lateral: float
    ) -> npt.NDArray[np.float64]: ...
    def local_coordinates(self, position: npt.ArrayLike) -> tuple[float, float]: ...
    def heading_at(self, longitudinal: float) -> float: ...
    def width_at(self, longitudinal: float) -> float: ...

class StraightLane(AbstractLane):
    start: npt.NDArray[np.float64]
    end: npt.NDArray[np.float64]
    direction: npt.NDArray[np.float64]
    def __init__(
        self,
        start: npt.ArrayLike,
        end: npt.ArrayLike,
        width: float = ...,
        line_types: Sequence[int] | None = ...,
        forbidden: bool = ...,
        speed_limit: float = ...,
        priority: int = ...,
    ) -> None: ...

class CircularLane(AbstractLane):
    center: npt.NDArray[np.float64]
    radius: float
    start_phase: float
    end_phase: float
    direction: int
    def __init__(
        self,
        center: npt.ArrayLike,
        radius: float,
        start_phase: float,
        end_phase: float,
        clockwise: bool = ...,
        width: float = ...,
        line_types: Sequence[int] | None = ...,
        forbidden: bool = ...,
        speed_limit: float = ...,
        priority: int = ...,
    ) -> None: ...
