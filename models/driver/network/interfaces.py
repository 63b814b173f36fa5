"""What the planner reads, and what it returns."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.driver.network.config import STEPS

SPEED_SCALE_MPS = 10.0
"""The ego's speed is given in these units, about 1 in size."""
EGO_FEATURES = 2
"""Speed over 10 m/s, and how lately it stood. Acceleration and yaw rate are left out:
an imitator that sees them goes on with what it does, and never begins to brake (causal
confusion: de Haan et al., 2019; seen here in the first driver)."""


@dataclass
class EgoState:
    """State of the ego.

    Attributes:
        can_bus: [B, 18], see the policy contract.
        stood: [B] 1 while it stands, then decaying.
    """

    can_bus: Tensor
    stood: Tensor

    def features(self) -> Tensor:
        """Return [B, 2], each about 1 in size: see `EGO_FEATURES`."""
        return torch.stack([self.can_bus[:, 7] / SPEED_SCALE_MPS, self.stood], -1)


@dataclass
class PlannerInput:
    """What the planner reads: the outputs of the other modules, and nothing else.

    Attributes:
        agents: [B, A, C] queries of the motion module.
        boxes: [B, A, 8] of the track module.
        score: [B, A] of the track module.
        travel: [B, A, M, 6, 2] of the motion module.
        modes: [B, A, M] probabilities, of the motion module.
        lateral: [B] metres that the ego is left of the route of the command, of the
            map module.
        path: [B, P, 2] that route, of the map module.
        headings: [B, P] of it.
        attributes: [B, P, 4] of it.
        points: [B, P, C] its queries.
        raster: [B, 4, H, W] probabilities, of the map module.
        signal_query: [B, 3, C] of the map module.
        signals: [B, 3, 5] of the map module.
        occupancy: [B, 6, H, W] probabilities, of the occ module.
    """

    agents: Tensor
    boxes: Tensor
    score: Tensor
    travel: Tensor
    modes: Tensor
    lateral: Tensor
    path: Tensor
    headings: Tensor
    attributes: Tensor
    points: Tensor
    raster: Tensor
    signal_query: Tensor
    signals: Tensor
    occupancy: Tensor


@dataclass
class Candidates:
    """What the planner considered.

    Attributes:
        plans: [B, K, 6, 2] metres in the ego frame.
        moves: [B, K, 6, 2] metres along the route, and to the left of where the ego is
            beside it.
        anchors: [B, K, 6, 2] the same before the planner bends them.
        headings: [B, K, 6] radians, along the route.
        logits: [B, K].
        costs: [B, K, F] what the score was made of.
    """

    plans: Tensor
    moves: Tensor
    anchors: Tensor
    headings: Tensor
    logits: Tensor
    costs: Tensor

    def best(self) -> Tensor:
        """Return the plan with the highest score: [B, 6, 2]."""
        first = self.logits.argmax(1)[:, None, None, None]
        return self.plans.gather(1, first.expand(-1, -1, STEPS, 2)).squeeze(1)
