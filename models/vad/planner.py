"""The prediction and planning part of the head: agents' and the ego's future."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from models.bev.decoder import Interaction
from models.bev.layers import classifier, mlp
from models.bev.sizes import EMBED, Sampling
from models.bev.transformer import Motions
from models.regions import region
from models.vad.config import (
    AGENT_MODES,
    LAYERS,
    MAP_REACH,
    MAP_SCORE,
    STEPS,
    Heads,
    VadConfig,
)
from models.vad.perception import (
    AgentOutputs,
    MapOutputs,
    PerceptionHead,
)

Outputs = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


class MotionOutputs(NamedTuple):
    """Forecasts of every agent."""

    steps: Tensor  # [3, 1, 300, 6, 12], metres a step
    scores: Tensor  # [3, 1, 300, 6], logits
    queries: Tensor  # [1, 300, 6, 512]


class PointMlp(nn.Module):
    """Linear, normalisation, ReLU."""

    def __init__(self, width: int, out: int) -> None:
        super().__init__()
        self.linear = nn.Linear(width, out)
        self.norm = nn.LayerNorm(out)

    def forward(self, x: Tensor) -> Tensor:
        """Map [..., width] to [..., out]."""
        return torch.relu(self.norm(self.linear(x)))


class LaneNet(nn.Module):
    """Maps the points of a vector to one query (VectorNet's sub-graph)."""

    def __init__(self) -> None:
        super().__init__()
        self.layer_seq = nn.Sequential()
        for layer in range(LAYERS):
            self.layer_seq.add_module(f"lmlp_{layer}", PointMlp(EMBED, EMBED // 2))

    def forward(self, points: Tensor) -> Tensor:
        """Map [1, V, P, 256] to [1, V, 256]."""
        for layer in self.layer_seq:
            own = layer(points)
            shared = own.amax(2, keepdim=True).expand_as(own)
            points = torch.cat([own, shared], -1)
        return points.amax(2)


def nearest_points(points: Tensor) -> Tensor:
    """Return the point of each vector nearest to the origin: [1, V, 2].

    As in the original, the points are normalised: the origin is a corner of the grid
    and not the ego vehicle.
    """
    index = points.square().sum(-1).argmin(-1, keepdim=True)
    return points.gather(2, index.unsqueeze(-1).expand(-1, -1, -1, 2)).squeeze(2)


class PlanningHead(PerceptionHead):
    """The whole head: agents and the ego query attend to each other and to the map."""

    def __init__(self, heads: Heads, sampling: Sampling, config: VadConfig) -> None:
        super().__init__(heads, sampling, config)
        # Motion of the agents, in six modes
        self.motion_decoder = Interaction()
        self.motion_mode_query = nn.Embedding(AGENT_MODES, EMBED)
        self.pos_mlp_sa = nn.Linear(2, EMBED)
        self.lane_encoder = LaneNet()
        self.motion_map_decoder = Interaction()
        self.pos_mlp = nn.Linear(2, EMBED)
        self.traj_branches = nn.ModuleList([_trajectories(1)])
        self.traj_cls_branches = nn.ModuleList([classifier(1, 2 * EMBED)])
        # The plan, for every command
        self.ego_modes = heads.ego_modes
        self.ego_query = nn.Embedding(1, EMBED)
        self.ego_agent_decoder = Interaction()
        self.ego_agent_pos_mlp = nn.Linear(2, EMBED)
        self.ego_map_decoder = Interaction()
        self.ego_map_pos_mlp = nn.Linear(2, EMBED)
        self.agent_fus_mlp = nn.Sequential(
            nn.Linear(AGENT_MODES * 2 * EMBED, EMBED),
            nn.LayerNorm(EMBED),
            nn.ReLU(),
            nn.Linear(EMBED, EMBED),
        )
        self.ego_fut_decoder = _trajectories(heads.ego_modes)

    def forward(
        self, features: Tensor, lidar2img: Tensor, can_bus: Tensor, prev_bev: Tensor
    ) -> Outputs:
        """Map camera features [cameras, 256, h, w] to all outputs of the stack."""
        motions = Motions(lidar2img, can_bus, prev_bev)
        bev, agents, vectors = self.perceive(features, motions)
        lanes = self.lanes(vectors)
        motion = self.forecast(agents, vectors, lanes)
        plan = self.plan(agents, motion, lanes)
        with region("bev_encoder"):
            bev = bev.transpose(0, 1)
        return (
            bev,
            agents.scores,
            agents.boxes,
            motion.steps,
            motion.scores,
            vectors.scores,
            vectors.boxes,
            vectors.points,
            plan,
        )

    def lanes(self, vectors: MapOutputs) -> tuple[Tensor, Tensor]:
        """Return a query [1, 100, 256] and a position [1, 100, 2] per vector."""
        with region("map"):
            return self.lane_encoder(vectors.queries), nearest_points(
                vectors.points[-1]
            )

    def forecast(
        self, agents: AgentOutputs, vectors: MapOutputs, lanes: tuple[Tensor, Tensor]
    ) -> MotionOutputs:
        """Predict the motion of all agents in all modes."""
        with region("motion"):
            # One query per agent and mode
            query = agents.queries.unsqueeze(2) + self.motion_mode_query.weight
            query = query.flatten(1, 2)
            centres = agents.centres.unsqueeze(2).expand(-1, -1, AGENT_MODES, -1)
            centres = centres.flatten(1, 2)
            pos = self.pos_mlp_sa(centres)
            social = self.motion_decoder(query, query, pos, pos)
            aware = self._read_map(social, centres, vectors, lanes)
            # Trajectories from social and map context
            both = torch.cat([social, aware], -1)
            both = both.view(1, self.config.agents, AGENT_MODES, 2 * EMBED)
            steps = self.traj_branches[0](both)
            scores = self.traj_cls_branches[0](both).squeeze(-1)
            return MotionOutputs(
                steps.unsqueeze(0).repeat(LAYERS, 1, 1, 1, 1),
                scores.unsqueeze(0).repeat(LAYERS, 1, 1, 1),
                both,
            )

    def _read_map(
        self,
        query: Tensor,
        centres: Tensor,
        vectors: MapOutputs,
        lanes: tuple[Tensor, Tensor],
    ) -> Tensor:
        """Let each agent-mode attend to the likely map vectors near it.

        The original gathers these vectors; here the others are masked, which gives the
        same attention at fixed shapes. One empty vector is always visible.
        """
        # Mask unlikely and distant vectors
        lane_query, lane_at = lanes
        unlikely = vectors.scores[-1].sigmoid().amax(-1) <= MAP_SCORE
        offset = lane_at.unsqueeze(1) - centres.unsqueeze(2)
        far = offset.square().sum(-1).sqrt() > MAP_REACH
        ignore = torch.logical_or(far, unlikely.unsqueeze(1))[0]
        ignore = _append_zero(ignore)
        offset = _append_zero(offset[0])
        # Attend, one batch entry per agent-mode
        key = _append_zero(lane_query)
        query = query.transpose(0, 1)
        key_pos = self.pos_mlp(offset)
        query_pos = self.pos_mlp(torch.zeros_like(query[..., :2]))
        aware = self.motion_map_decoder(query, key, query_pos, key_pos, ignore)
        out: Tensor = aware.transpose(0, 1)
        return out

    def plan(
        self, agents: AgentOutputs, motion: MotionOutputs, lanes: tuple[Tensor, Tensor]
    ) -> Tensor:
        """Return [1, modes, 6, 2]: metres per step of 0.5 s, for every command."""
        with region("planner"):
            lane_query, lane_at = lanes
            ego = self.ego_query.weight.unsqueeze(0)
            origin = torch.zeros_like(ego[..., :2])
            # Read the agents, then the map
            social = self.ego_agent_decoder(
                ego,
                self.agent_fus_mlp(motion.queries.flatten(2)),
                self.ego_agent_pos_mlp(origin),
                self.ego_agent_pos_mlp(agents.centres),
            )
            aware = self.ego_map_decoder(
                social,
                lane_query,
                self.ego_map_pos_mlp(origin),
                self.ego_map_pos_mlp(lane_at),
            )
            # One plan per command
            deltas = self.ego_fut_decoder(torch.cat([social, aware], -1))
            out: Tensor = deltas.view(1, self.ego_modes, STEPS, 2)
            return out


def _append_zero(x: Tensor) -> Tensor:
    return torch.cat([x, torch.zeros_like(x[:, :1])], 1)


def _trajectories(modes: int) -> nn.Sequential:
    return mlp(2 * EMBED, 2 * EMBED, 2 * EMBED, modes * STEPS * 2)
