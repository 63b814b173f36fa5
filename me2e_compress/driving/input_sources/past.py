"""Input sources of the ego's history: positions, headings, speeds."""

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from me2e_compress.driving.input_sources.base import InputSource, Observed
from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.frames import Array

Quantity = Literal["x", "y", "heading", "speed"]


@dataclass(frozen=True)
class Past(InputSource):
    """States of the ego before now: [steps, quantities], the oldest first.

    Positions and headings are relative to the present pose, metres and radians in the
    model's axes; the present is not among them. Between decisions they are
    interpolated; before a route's first decision the ego stood still.

    Attributes:
        steps: How many states.
        spacing_s: Seconds from one to the next, the last being that long ago.
        quantities: Columns of the result: x, y, heading, speed (m/s).
        deltas: Changes from each state to the one after it, the last one to now.
        newest_first: Reverse the order.
    """

    name: ClassVar[str] = "past"
    steps: int
    spacing_s: float = 0.5
    quantities: tuple[Quantity, ...] = ("x", "y")
    deltas: bool = False
    newest_first: bool = False

    def __post_init__(self) -> None:
        if self.steps < 1 or not 0.0 < self.spacing_s < float("inf"):
            raise EvaluationError(
                f"past: {self.steps} steps {self.spacing_s:g} s apart: both must be"
                " positive"
            )

    def value(self, seen: Observed) -> Array:
        """Return float64 [steps, quantities]."""
        # the ego's states, the present one last
        now = seen.motion
        back = 1e6 * self.spacing_s * np.arange(self.steps, -1, -1)
        states = seen.track.at(seen.observation.time_us - back)
        # relative to the present pose, in the model's axes
        states[:, :3] -= (now.x, now.y, states[-1, 2])
        cos, sin = np.cos(now.heading), np.sin(now.heading)
        in_ego = states[:, :2] @ np.array([[cos, -sin], [sin, cos]])
        states[:, :2] = seen.turned(in_ego)
        states[:, 2] *= -1.0 if seen.axes.is_left_handed else 1.0
        found = np.diff(states, axis=0) if self.deltas else states[:-1]
        columns = [("x", "y", "heading", "speed").index(q) for q in self.quantities]
        return found[:: -1 if self.newest_first else 1, columns]
