"""What really happened after a frame was recorded: ground truth for a plan."""

from typing import Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, FiniteFloat, NonNegativeInt

STEPS = 6
STEP_S = 0.5
"""Three seconds, as UniAD and VAD plan them."""

Point: TypeAlias = tuple[FiniteFloat, FiniteFloat]
Box: TypeAlias = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]


class RecordedFuture(BaseModel):
    """Where the ego and the others went, in the ground frame of the model's plan.

    Metres and radians counter-clockwise from the x axis, as seen from where the ego
    stood at the frame.

    Attributes:
        version: of this format.
        waypoints: of the ego after 0.5, 1, ... 3 s; None where the log ended before.
        forward: where the ego looked at the frame.
        ego: length and width of the ego.
        centre: of the ego at the frame: the origin may be its lidar.
        agents: x, y, heading, length and width of every road user, step by step; None
            where the log does not tell of them.
        command: where the route went, as the model counts commands.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    version: Literal[1] = 1
    waypoints: tuple[Point | None, ...]
    forward: FiniteFloat
    ego: tuple[FiniteFloat, FiniteFloat]
    centre: Point
    agents: tuple[tuple[Box, ...], ...] | None
    command: NonNegativeInt

    @property
    def whole(self) -> bool:
        """Whether the log went on for all of the three seconds."""
        return len(self.waypoints) == STEPS and None not in self.waypoints
