"""Where the motion head begins: six ways to go on, in the frame of an agent."""

from typing import NamedTuple, Self

import torch
from torch import Tensor

from me2e_compress.zoo.uniad.config import AGENT_STEPS

STEP_S = 0.5

WAYS = ((0.0, 0.0), (0.5, 0.0), (1.0, 0.0), (1.5, 0.0), (0.7, 0.4), (0.7, -0.4))
"""Parts of a group's speed, and radians that are turned every second."""

SPEEDS_MPS = (8.0, 4.0, 1.5, 0.5)
"""Of vehicles, bicycles, pedestrians and what else nuScenes has."""

TINY = torch.tensor(1.0e-5)


def anchors(groups: int) -> Tensor:
    """Return [groups, 6, 12, 2], metres, the agent's frame, y ahead.

    The published anchors are k-means centres of the data set's trajectories; they are
    in no checkpoint, and these six arcs a group stand for them.
    """
    seconds = torch.arange(1, AGENT_STEPS + 1) * STEP_S
    ways = []
    for part, rate in WAYS:
        heading = seconds * rate
        steps = torch.stack([-heading.sin(), heading.cos()], -1) * (part * STEP_S)
        ways.append(steps.cumsum(0))
    speeds = torch.tensor(SPEEDS_MPS[:groups]).view(-1, 1, 1, 1)
    return torch.stack(ways) * speeds


class AgentFrames(NamedTuple):
    """Where agents are and how they are turned, in the lidar frame."""

    centre: Tensor  # [A, 1, 1, 2], metres
    cos: Tensor  # [A, 1, 1]
    sin: Tensor  # [A, 1, 1]

    @classmethod
    def of(cls, boxes: Tensor) -> Self:
        """Read boxes [A, 10]. As in the original, an agent faces yaw - pi."""
        sin, cos = boxes[:, 6:7], boxes[:, 7:8]
        length = torch.maximum((sin * sin + cos * cos).sqrt(), TINY)
        return cls(
            boxes[:, None, None, :2],
            (-cos / length).unsqueeze(2),
            (-sin / length).unsqueeze(2),
        )

    def turned(self, points: Tensor) -> Tensor:
        """Turn points [A, modes, steps, 2] of the agents to the axes of the lidar."""
        x, y = points[..., 0], points[..., 1]
        return torch.stack(
            [self.cos * x - self.sin * y, self.sin * x + self.cos * y], -1
        )

    def turned_back(self, points: Tensor) -> Tensor:
        """Undo `turned`."""
        x, y = points[..., 0], points[..., 1]
        return torch.stack(
            [self.cos * x + self.sin * y, self.cos * y - self.sin * x], -1
        )
