"""The recorded future after a frame: ground truth for a plan."""

from typing import Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, FiniteFloat, NonNegativeInt

STEPS = 6
STEP_S = 0.5
"""Six steps of 0.5 s give the three seconds that UniAD and VAD plan."""

Point: TypeAlias = tuple[FiniteFloat, FiniteFloat]
Box: TypeAlias = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]


class RecordedFuture(BaseModel):
    """The future of the ego and other road users, in the ground frame of the plan.

    Metres and radians counter-clockwise from the x axis, relative to the ego's position
    at the frame.

    Attributes:
        version: version of this format.
        waypoints: ego positions after 0.5, 1, ... 3 s; None where the log ended before.
        forward: heading of the ego at the frame.
        ego: length and width of the ego.
        centre: centre of the ego at the frame: the origin may be its lidar.
        agents: x, y, heading, length and width of every road user at each step; None
            where the log has none of them.
        command: the route's command, as the model numbers commands.
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
        """Whether the log covers all of the three seconds."""
        return len(self.waypoints) == STEPS and None not in self.waypoints
