"""The plan: candidates along the commanded route, scored by what they would meet."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from me2e_compress.zoo.highway.candidates import along, hats
from me2e_compress.zoo.highway.config import (
    COMMANDS,
    PATH_STEP_M,
    RASTER_CHANNELS,
    SIGNAL_KINDS,
    STEP_S,
    STEPS,
    HighwayConfig,
)
from me2e_compress.zoo.highway.costs import (
    agent_costs,
    between,
    beyond_lines,
    discs_of,
    ground,
    occupied,
)
from me2e_compress.zoo.highway.layers import DecoderLayer, conv_block, mlp
from me2e_compress.zoo.highway.map import GAP_SCALE_M, RoadMap
from me2e_compress.zoo.highway.motion import Futures
from me2e_compress.zoo.highway.track import Tracks

SPEED_SCALE_MPS = 10.0
EGO_FEATURES = 5
"""Speed, longitudinal and lateral acceleration, yaw rate, how lately it stood."""
LIMITS = 4
"""Too fast, too far left, too far right, left of the oncoming lanes."""
COSTS = STEPS * (2 * 2 + 1 + RASTER_CHANNELS + SIGNAL_KINDS + LIMITS)
"""Overlap and nearness at twelve instants, the rest at six."""


@dataclass
class EgoState:
    """What the ego does.

    Attributes:
        can_bus: [B, 18], see the policy contract.
        stood: [B] 1 while it stands, then forgotten.
    """

    can_bus: Tensor
    stood: Tensor

    def features(self) -> Tensor:
        """[B, 5], each about 1 in size: see `EGO_FEATURES`."""
        bus = self.can_bus
        columns = [
            bus[:, 7] / SPEED_SCALE_MPS,
            bus[:, 10] / 3,
            bus[:, 11] / 3,
            bus[:, 15] * 2,
        ]
        return torch.stack([*columns, self.stood], -1)


@dataclass
class World:
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
        logits: [B, K].
        costs: [B, K, F] what the score was made of.
    """

    plans: Tensor
    moves: Tensor
    anchors: Tensor
    logits: Tensor
    costs: Tensor

    def best(self) -> Tensor:
        """The plan with the highest score: [B, 6, 2]."""
        first = self.logits.argmax(1)[:, None, None, None]
        return self.plans.gather(1, first.expand(-1, -1, STEPS, 2)).squeeze(1)


def world_of(
    tracks: Tracks, road: RoadMap, futures: Futures, occupancy: Tensor, command: Tensor
) -> World:
    """Gather what the planner reads; the command picks the route.

    Args:
        tracks: of the track module.
        road: of the map module.
        futures: of the motion module.
        occupancy: [B, 6, H, W] logits of the occ module.
        command: int64 [B].
    """
    pick = command[:, None] == torch.arange(COMMANDS, device=command.device)
    chosen = pick.to(road.paths.dtype)
    queries = road.query.unflatten(1, (COMMANDS, -1))
    return World(
        futures.query,
        tracks.boxes,
        tracks.score,
        futures.travel,
        futures.logits.softmax(-1),
        (road.lateral * chosen).sum(1),
        (road.paths * chosen[:, :, None, None]).sum(1),
        (road.headings * chosen[:, :, None]).sum(1),
        (road.attributes * chosen[:, :, None, None]).sum(1),
        (queries * chosen[:, :, None, None].to(queries.dtype)).sum(1),
        road.raster.sigmoid(),
        road.signal_query,
        road.signals,
        occupancy.sigmoid(),
    )


class Planner(nn.Module):
    """Anchored candidates (VADv2's vocabulary, in the frame of the route) and costs.

    An anchor is a departure from going on as now: metres more or less along the route,
    metres to the left.

    The collision cost of a candidate is computed from predicted boxes, their futures
    and the predicted occupancy, the way it leaves the road from the predicted map: so
    that no module can be left out unnoticed.
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
        self.ego = mlp(EGO_FEATURES + COMMANDS, channels, channels)
        self.box = mlp(9, channels, channels)
        self.road = mlp(6, channels, channels)
        self.grid = nn.Sequential(
            conv_block(STEPS, 32, 3, 4), conv_block(32, channels, 3, 2)
        )
        self.cells = nn.Parameter(torch.randn(1, 48, channels) * 0.1)
        self.agent_layer = DecoderLayer(channels, heads)
        self.road_layer = DecoderLayer(channels, heads, selfish=False)
        self.grid_layer = DecoderLayer(channels, heads, selfish=False)
        self.refine = mlp(channels, channels, STEPS * 2)
        self.score = mlp(channels + COSTS, 128, 64, 1)
        self.penalty = mlp(EGO_FEATURES, 16, 4)

    def forward(
        self,
        tracks: Tracks,
        road: RoadMap,
        futures: Futures,
        occupancy: Tensor,
        ego: EgoState,
        command: Tensor,
    ) -> tuple[Tensor, World]:
        """Decide.

        Args:
            tracks: of the track module.
            road: of the map module.
            futures: of the motion module.
            occupancy: [B, 6, H, W] logits of the occ module.
            ego: what the ego does.
            command: int64 [B].

        Returns:
            (the best plan [B, 6, 2], what was read).
        """
        world = world_of(tracks, road, futures, occupancy, command)
        return self.consider(world, ego.features(), command).best(), world

    def consider(self, world: World, ego: Tensor, command: Tensor) -> Candidates:
        """Make the candidates and score them.

        Args:
            world: what the modules say.
            ego: [B, 5], see `EGO_FEATURES`.
            command: int64 [B].
        """
        anchors = self._anchors(ego)
        query = self._query(world, ego, command)
        moves = anchors + self.refine(query).float().unflatten(-1, (STEPS, 2))
        arc = moves[..., 0].clamp(0, self.end_m)
        offset = world.lateral[:, None, None] + moves[..., 1]
        plans, headings = along(arc, offset, world.path, world.headings)
        with torch.no_grad():
            costs, harm = self._costs(world, plans, headings, arc, offset)
        logits = self.score(torch.cat([query.float(), costs], -1)).squeeze(-1)
        weight = nn.functional.softplus(self.penalty(ego).float())
        logits = logits - (harm * weight[:, None]).sum(-1)
        return Candidates(plans, moves, anchors, logits, costs)

    def _anchors(self, ego: Tensor) -> Tensor:
        """[B, K, 6, 2]: going on at this speed, plus the anchors, never backwards."""
        coasting = ego[:, 0, None, None] * (SPEED_SCALE_MPS * self.times)
        arc = (coasting + self.anchors[..., 0]).clamp(min=0)
        aside = self.anchors[..., 1].expand_as(arc)
        return torch.stack([arc, aside], -1)

    def _query(self, world: World, ego: Tensor, command: Tensor) -> Tensor:
        """[B, K, C]: each anchor looks at agents, route, signals and occupancy."""
        pick = command[:, None] == torch.arange(COMMANDS, device=command.device)
        told = self.ego(torch.cat([ego, pick.to(ego.dtype)], -1))
        query = self.anchor(self.anchors.flatten(1) / 10) + told[:, None]
        boxes = torch.cat([world.boxes / 10, world.score[..., None]], -1)
        agents = (world.agents + self.box(boxes)) * world.score[..., None]
        query = self.agent_layer(query, agents, agents)
        route = torch.cat([world.path / 10, world.attributes / 10], -1)
        road = torch.cat([world.points + self.road(route), world.signal_query], 1)
        query = self.road_layer(query, road, road)
        taken = self.grid(world.occupancy).flatten(2).transpose(1, 2) + self.cells
        return self.grid_layer(query, taken, taken)

    def _costs(
        self, world: World, plans: Tensor, headings: Tensor, arc: Tensor, offset: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Everything [B, K, F], and what is plain harm [B, K, 4]."""
        fine = between(plans.transpose(1, 2).flatten(2)).unflatten(2, (-1, 2))
        turns = between(headings.transpose(1, 2)).transpose(1, 2)
        overlap, near = agent_costs(
            discs_of(fine.transpose(1, 2), turns),
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

    def _lines(self, world: World, arc: Tensor) -> Tensor:
        """[B, K, 6, 3] beyond the line of a closed light, a stop sign, a give-way sign."""
        there = world.signals[..., 0].sigmoid()
        closed = 1 - world.signals[:, 0, 2:].softmax(-1)[:, 2]
        asked = torch.cat([(there[:, 0] * closed)[:, None], there[:, 1:]], 1)
        gap = world.signals[..., 1] * GAP_SCALE_M
        return beyond_lines(arc, gap) * asked[:, None, None]

    def _limits(self, world: World, arc: Tensor, offset: Tensor) -> Tensor:
        """[B, K, 6, 4] too fast, too far left, right, left of the oncoming lanes."""
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
            ],
            -1,
        )


def between_travel(travel: Tensor) -> Tensor:
    """[B, A, M, 6, 2] to every quarter of a second: [B, A, M, 12, 2]."""
    shape = travel.shape[:3]
    return between(travel.flatten(0, 2)).unflatten(0, shape)


__all__ = ["SIGNAL_KINDS", "Candidates", "Planner", "World", "world_of"]
