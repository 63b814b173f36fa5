"""Losses of the plan: which candidate, how it bends, and what it would hit."""

import torch
from torch import Tensor
from torch.nn import functional

from models.driver.label_tensors import Labels
from models.driver.network.config import STEP_S, STEPS, BevArea
from models.driver.network.costs import (
    agent_costs,
    between_travel,
    beyond_lines,
    discs_of,
    ground,
    swept,
)
from models.driver.network.interfaces import Candidates

NEAR_STEPS = (3.0, 2.0, 1.5, 1.0, 0.75, 0.75)
"""Weights of the waypoints: the controller uses the first two."""
ASIDE = 2.0
"""A metre to the side counts as two along the route."""
SOFT_M = 0.2
"""How much farther than the best candidate another one may be and still count."""
DOOMED = 0.5
"""An expert's plan that overlaps an agent by more than this in its first two seconds is
not learned from: the expert gave up, or the driver had left it no way out."""
DOOMED_INSTANTS = 8
"""Of a quarter of a second each."""
STILL_M = 0.05
"""A step shorter than this has no direction of its own."""
DECISIVE = 2.0
"""Extra weight of samples where the actors change the plan."""


def plan_losses(
    candidates: Candidates, wanted: Labels, area: BevArea
) -> dict[str, Tensor]:
    """Return the losses of choice, refinement, place and safety of the plan.

    Args:
        candidates: of the planner.
        wanted: labels.
        area: of the bird's-eye view.
    """
    steps = torch.tensor(NEAR_STEPS) / sum(NEAR_STEPS)
    side = torch.tensor([1.0, ASIDE])
    aim = wanted.moves[:, None]
    to_anchor = ((candidates.anchors - aim).abs() * side).sum(-1) @ steps
    to_plan = ((candidates.moves.detach() - aim).abs() * side).sum(-1) @ steps
    share = functional.softmax(-to_plan / SOFT_M, -1)
    weight = 1 + DECISIVE * (wanted.shift_m > 0.5).float()
    weight = weight * ~doomed(wanted)
    weight = weight / weight.mean().clamp(min=1e-3)
    choice = -(share * candidates.logits.log_softmax(-1)).sum(-1)
    best = to_anchor.argmin(1)
    rows = torch.arange(len(best))
    bend = ((candidates.moves[rows, best] - wanted.moves).abs() * side).sum(-1) @ steps
    place = (candidates.plans[rows, best] - wanted.plan).abs().sum(-1) @ steps
    harm = true_harm(candidates, wanted, area)
    more = (harm - harm[rows, best][:, None]).clamp(min=0)
    return {
        "choice": (choice * weight).mean(),
        "bend": (bend * weight).mean(),
        "place": (place * weight).mean(),
        "safe": (candidates.logits.softmax(-1) * more).sum(-1).mean(),
    }


@torch.no_grad()
def true_harm(candidates: Candidates, wanted: Labels, area: BevArea) -> Tensor:
    """Return [B, K], what each candidate would have hit (Hydra-MDP, 2024).

    Rules as targets: overlap with where the agents really were, ground that is not
    road, lines of lights that are not green.

    Args:
        candidates: of the planner.
        wanted: labels.
        area: of the bird's-eye view.
    """
    plans, headings = candidates.plans.detach(), candidates.headings.detach()
    overlap = _overlap(plans, headings, wanted)
    under = ground(discs_of(plans, headings), wanted.raster, area)
    beside = (1 - under[..., 0] - under[..., 1]).clamp(min=0).amax(-1)
    there, gap, state = wanted.signals[:, 0].unbind(-1)
    closed = there * ((state == 0) | (state == 1))
    past = beyond_lines(candidates.moves[..., 0].detach(), gap[:, None]).amax(2)[..., 0]
    return overlap.amax(-1) + beside + past * closed[:, None]


@torch.no_grad()
def doomed(wanted: Labels) -> Tensor:
    """Return [B]: whether the expert's own plan hits an agent soon."""
    plan = wanted.plan
    step = torch.diff(plan, dim=1, prepend=torch.zeros_like(plan[:, :1]))
    heading = torch.atan2(step[..., 1], step[..., 0])
    heading = heading * (step.norm(dim=-1) > STILL_M)
    overlap = _overlap(plan[:, None], heading[:, None], wanted)
    soon: Tensor = overlap[:, 0, :DOOMED_INSTANTS].amax(-1) > DOOMED
    return soon


def _overlap(plans: Tensor, headings: Tensor, wanted: Labels) -> Tensor:
    """Return [B, K, 12], overlap with where the agents really were, every 0.25 s."""
    agents = wanted.agents
    columns = [1, 2, 5, 6, 3, 4, 7, 8]
    drift = agents[:, :, None, 7:9] * STEP_S * torch.arange(1, 1 + STEPS)[:, None]
    travel = torch.where(wanted.travel_known[..., None], wanted.travel, drift)
    overlap, _ = agent_costs(
        swept(plans, headings),
        agents[..., columns],
        wanted.there.float(),
        between_travel(travel[:, :, None]),
        torch.ones_like(agents[..., :1]),
    )
    return overlap


def displacement(plans: Tensor, wanted: Labels) -> Tensor:
    """Return [B], mean distance of plans [B, 6, 2] from the expert's, metres."""
    away: Tensor = (plans - wanted.plan).norm(dim=-1)
    return away.mean(-1)
