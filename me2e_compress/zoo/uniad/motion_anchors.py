"""Motion anchors: six arcs in the frame of an agent."""

from typing import NamedTuple, Self

import torch
from torch import Tensor

from me2e_compress.zoo.uniad.config import AGENT_STEPS

STEP_S = 0.5

WAYS = ((0.0, 0.0), (0.5, 0.0), (1.0, 0.0), (1.5, 0.0), (0.7, 0.4), (0.7, -0.4))
"""Fraction of a group's speed, and radians per second, for each arc."""

SPEEDS_MPS = (8.0, 4.0, 1.5, 0.5)
"""Speeds of vehicles, bicycles, pedestrians and nuScenes' other objects."""

TINY = torch.tensor(1.0e-5)


def anchors(groups: int) -> Tensor:
    """Return [groups, 6, 12, 2], metres, in the agent's frame, y ahead.

    The published anchors are k-means centres of the data set's trajectories; they are
    in no checkpoint, and six arcs per group replace them.
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
    """Positions and orientations of agents in the lidar frame."""

    centre: Tensor  # [A, 1, 1, 2], metres
    cos: Tensor  # [A, 1, 1]
    sin: Tensor  # [A, 1, 1]

    @classmethod
    def of(cls, boxes: Tensor) -> Self:
        """Return the frames of boxes [A, 10]; agents face yaw - pi (original)."""
        sin, cos = boxes[:, 6:7], boxes[:, 7:8]
        length = torch.maximum((sin * sin + cos * cos).sqrt(), TINY)
        return cls(
            boxes[:, None, None, :2],
            (-cos / length).unsqueeze(2),
            (-sin / length).unsqueeze(2),
        )

    def turned(self, points: Tensor) -> Tensor:
        """Rotate points [A, modes, steps, 2] of the agents to the axes of the lidar."""
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
