"""The planner: candidates along the commanded route, scored by what they would hit."""

import torch
from torch import Tensor, nn

from models.driver.network.blocks import DecoderLayer, conv_block, mlp
from models.driver.network.config import (
    COMMANDS,
    PATH_STEP_M,
    RASTER_CHANNELS,
    SIGNAL_KINDS,
    STEP_S,
    STEPS,
    HighwayConfig,
)
from models.driver.network.costs import (
    agent_costs,
    between_travel,
    beyond_lines,
    discs_of,
    ground,
    occupied,
    swept,
)
from models.driver.network.interfaces import (
    EGO_FEATURES,
    SPEED_SCALE_MPS,
    Candidates,
    EgoState,
    PlannerInput,
)
from models.driver.network.map import GAP_SCALE_M


def hats(arc_m: Tensor, points: int) -> Tensor:
    """Return [..., P] weights that interpolate linearly between a route's points."""
    knots = torch.arange(points, device=arc_m.device, dtype=arc_m.dtype)
    return (1 - (arc_m[..., None] / PATH_STEP_M - knots).abs()).clamp(min=0)


def along(
    arc_m: Tensor, offset_m: Tensor, path: Tensor, headings: Tensor
) -> tuple[Tensor, Tensor]:
    """Return places beside a route.

    Args:
        arc_m: [B, K, T] metres along it, 0 to its length.
        offset_m: [B, K, T] metres to the left of it.
        path: [B, P, 2].
        headings: [B, P].

    Returns:
        ([B, K, T, 2] metres in the ego frame, [B, K, T] headings).
    """
    weights = hats(arc_m, path.shape[1])
    shape = weights.shape[:3]
    flat = weights.flatten(1, 2)
    table = torch.cat([path, headings[..., None]], -1)
    found = torch.matmul(flat, table).unflatten(1, shape[1:])
    heading = found[..., 2]
    left = torch.stack([-heading.sin(), heading.cos()], -1)
    return found[..., :2] + offset_m[..., None] * left, heading


LIMITS = 5
"""Too fast, too far left, too far right, left of the oncoming lanes, off the route."""
BENDS = (0, 3, 6)
"""Points of the route, 2 m apart, whose headings tell how the ego stands to it."""
ASIDE = 1 + len(BENDS)
"""How far the ego is beside the route, and those headings."""
COSTS = STEPS * (2 * 2 + 1 + RASTER_CHANNELS + SIGNAL_KINDS + LIMITS)
"""Overlap and nearness at twelve instants, the rest at six."""


BESIDE_M = 4.0
"""An offset of a lane or more is no worse than this."""
CAUTION = 4.0
"""What a certain collision costs before training, in units of the logits."""


class Planner(nn.Module):
    """Anchored candidates (VADv2's vocabulary, in the frame of the route) and costs.

    An anchor is a departure from coasting: metres more or less along the route, metres
    to the left.

    The collision cost of a candidate is computed from predicted boxes, their futures
    and the predicted occupancy, leaving the road from the predicted map: so no module
    can be left out unnoticed.
    """

    anchors: Tensor
    times: Tensor

    def __init__(self, config: HighwayConfig) -> None:
        super().__init__()
        channels, heads = config.channels, config.heads
        self.area, self.end_m = config.area, (config.path_points - 1) * PATH_STEP_M
        self.register_buffer("anchors", torch.zeros(config.anchors, STEPS, 2))
        times = STEP_S * torch.arange(1, STEPS + 1)
        self.register_buffer("times", times, False)
        self.anchor = mlp(STEPS * 2, channels, channels)
        self.ego = mlp(EGO_FEATURES + COMMANDS + ASIDE, channels, channels)
        self.box = mlp(9, channels, channels)
        self.road = mlp(6, channels, channels)
        self.grid = nn.Sequential(
            conv_block(STEPS, 32, 3, 4), conv_block(32, channels, 3, 2)
        )
        # the occupancy has two cells a cell, and is read in steps of eight
        places = (2 * self.area.rows // 8) * (2 * self.area.columns // 8)
        self.cells = nn.Parameter(torch.randn(1, places, channels) * 0.1)
        self.agent_layer = DecoderLayer(channels, heads)
        self.road_layer = DecoderLayer(channels, heads, selfish=False)
        self.grid_layer = DecoderLayer(channels, heads, selfish=False)
        self.refine = mlp(channels, channels, STEPS * 2)
        self.score = mlp(channels + COSTS, 128, 64, 1)
        self.penalty = mlp(EGO_FEATURES, 16, 4)
        nn.init.constant_(self.penalty.get_parameter("2.bias"), CAUTION)

    def forward(self, world: PlannerInput, ego: EgoState, command: Tensor) -> Tensor:
        """Decide: the best plan [B, 6, 2].

        Args:
            world: outputs of the other modules.
            ego: state of the ego.
            command: int64 [B].
        """
        return self.consider(world, ego.features(), command).best()

    def consider(self, world: PlannerInput, ego: Tensor, command: Tensor) -> Candidates:
        """Make the candidates and score them.

        Args:
            world: outputs of the other modules.
            ego: [B, 2], see `EGO_FEATURES`.
            command: int64 [B].
        """
        # candidates: anchors, refined by what they attend to
        anchors = self._anchors(ego)
        query = self._query(world, ego, command)
        moves = anchors + self.refine(query).float().unflatten(-1, (STEPS, 2))
        arc = moves[..., 0].clamp(0, self.end_m)
        offset = world.lateral[:, None, None] + moves[..., 1]
        plans, headings = along(arc, offset, world.path, world.headings)
        # scores: learned from the costs, less a penalty for plain harm
        with torch.no_grad():
            costs, harm = self._costs(world, plans, headings, arc, offset)
        logits = self.score(torch.cat([query.float(), costs], -1)).squeeze(-1)
        weight = nn.functional.softplus(self.penalty(ego).float())
        logits = logits - (harm * weight[:, None]).sum(-1)
        return Candidates(plans, moves, anchors, headings, logits, costs)

    def _anchors(self, ego: Tensor) -> Tensor:
        """Return [B, K, 6, 2]: coasting plus the anchors, never backwards."""
        coasting = ego[:, 0, None, None] * (SPEED_SCALE_MPS * self.times)
        arc = (coasting + self.anchors[..., 0]).clamp(min=0)
        aside = self.anchors[..., 1].expand_as(arc)
        return torch.stack([arc, aside], -1)

    def _query(self, world: PlannerInput, ego: Tensor, command: Tensor) -> Tensor:
        """Return [B, K, C]: anchors that attend to agents, road and occupancy."""
        pick = command[:, None] == torch.arange(COMMANDS, device=command.device)
        aside = torch.stack([world.lateral, *(world.headings[:, i] for i in BENDS)], -1)
        told = self.ego(torch.cat([ego, pick.to(ego.dtype), aside.to(ego.dtype)], -1))
        query = self.anchor(self.anchors.flatten(1) / 10) + told[:, None]
        boxes = torch.cat([world.boxes / 10, world.score[..., None]], -1)
        agents = (world.agents + self.box(boxes)) * world.score[..., None]
        query = self.agent_layer(query, agents, agents)
        route = torch.cat([world.path / 10, world.attributes / 10], -1)
        road = torch.cat([world.points + self.road(route), world.signal_query], 1)
        query = self.road_layer(query, road, road)
        taken = self.grid(world.occupancy).flatten(2).transpose(1, 2) + self.cells
        answer: Tensor = self.grid_layer(query, taken, taken)
        return answer

    def _costs(
        self,
        world: PlannerInput,
        plans: Tensor,
        headings: Tensor,
        arc: Tensor,
        offset: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Return all costs [B, K, F], and those that are plain harm [B, K, 4]."""
        overlap, near = agent_costs(
            swept(plans, headings),
            world.boxes,
            world.score,
            between_travel(world.travel),
            world.modes,
        )
        discs = discs_of(plans, headings)
        taken = occupied(discs, world.occupancy, self.area)
        under = ground(discs, world.raster, self.area)
        lines = self._lines(world, arc)
        limits = self._limits(world, arc, offset)
        costs = [
            overlap,
            near,
            taken,
            under.flatten(2),
            lines.flatten(2),
            limits.flatten(2),
        ]
        harm = torch.stack(
            [
                overlap.amax(-1),
                taken.amax(-1),
                (1 - under[..., 0] - under[..., 1]).clamp(min=0).amax(-1),
                lines[..., 0].amax(-1),
            ],
            -1,
        )
        return torch.cat(costs, -1), harm

    def _lines(self, world: PlannerInput, arc: Tensor) -> Tensor:
        """Return [B, K, 6, 3]: past the line of closed lights, stop, give-way signs."""
        there = world.signals[..., 0].sigmoid()
        closed = 1 - world.signals[:, 0, 2:].softmax(-1)[:, 2]
        asked = torch.cat([(there[:, 0] * closed)[:, None], there[:, 1:]], 1)
        gap = world.signals[..., 1] * GAP_SCALE_M
        return beyond_lines(arc, gap) * asked[:, None, None]

    def _limits(self, world: PlannerInput, arc: Tensor, offset: Tensor) -> Tensor:
        """Return [B, K, 6, 5], how far beyond each of `LIMITS`."""
        weights = hats(arc, world.path.shape[1]).flatten(1, 2)
        here = torch.matmul(weights, world.attributes).unflatten(1, arc.shape[1:])
        before = torch.cat([torch.zeros_like(arc[..., :1]), arc[..., :-1]], -1)
        speed = (arc - before) / STEP_S
        return torch.stack(
            [
                (speed - here[..., 3]) / 5,
                (offset + 1.0 - here[..., 0]).clamp(min=0),
                (1.0 - offset - here[..., 1]).clamp(min=0),
                (offset + 1.0 - here[..., 2]).clamp(min=0),
                offset.abs().clamp(max=BESIDE_M) / BESIDE_M,
            ],
            -1,
        )
