"""The expert's plan: which candidate, and how it bends."""

import torch
from torch import Tensor
from torch.nn import functional

from me2e_compress.zoo.highway.planner import Candidates
from me2e_compress.zoo.train.targets import Targets

NEAR_STEPS = (3.0, 2.0, 1.5, 1.0, 0.75, 0.75)
"""Weights of the waypoints: the controller acts on the first two."""
ASIDE = 2.0
"""A metre to the side counts as two along the route."""
SOFT_M = 0.2
"""How much farther than the best a candidate may be and still count."""
DECISIVE = 2.0
"""Extra weight of samples where the actors change the plan."""


def plan_losses(candidates: Candidates, wanted: Targets) -> dict[str, Tensor]:
    """Choice, and the distance of the right candidate.

    Args:
        candidates: of the planner.
        wanted: labels.
    """
    steps = torch.tensor(NEAR_STEPS) / sum(NEAR_STEPS)
    side = torch.tensor([1.0, ASIDE])
    aim = wanted.moves[:, None]
    to_anchor = ((candidates.anchors - aim).abs() * side).sum(-1) @ steps
    to_plan = ((candidates.moves.detach() - aim).abs() * side).sum(-1) @ steps
    share = functional.softmax(-to_plan / SOFT_M, -1)
    weight = 1 + DECISIVE * (wanted.shift_m > 0.5).float()
    weight = weight / weight.mean()
    choice = -(share * candidates.logits.log_softmax(-1)).sum(-1)
    best = to_anchor.argmin(1)
    rows = torch.arange(len(best))
    bend = ((candidates.moves[rows, best] - wanted.moves).abs() * side).sum(-1) @ steps
    place = (candidates.plans[rows, best] - wanted.plan).abs().sum(-1) @ steps
    return {
        "choice": (choice * weight).mean(),
        "bend": (bend * weight).mean(),
        "place": (place * weight).mean(),
    }


def displacement(plans: Tensor, wanted: Targets) -> Tensor:
    """[B] mean distance of plans [B, 6, 2] from the expert's, metres."""
    return (plans - wanted.plan).norm(dim=-1).mean(-1)
