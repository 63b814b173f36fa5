"""The motion head of UniAD: forecasts of the agents and the ego vehicle."""

from typing import NamedTuple, Self

import torch
from torch import Tensor, nn

from models.bev.layers import (
    AttentionLayer,
    TransformerLayer,
    classifier,
    mlp,
)
from models.bev.sizes import EMBED, Sampling
from models.uniad.config import AGENT_MODES, AGENT_STEPS, UniadConfig
from models.uniad.motion_goal import GoalAttention
from models.uniad.positions import PointSines

LAYERS = 3
OUTPUTS = 5
"""Mean x and y, both standard deviations, correlation."""

STEP_S = 0.5

WAYS = ((0.0, 0.0), (0.5, 0.0), (1.0, 0.0), (1.5, 0.0), (0.7, 0.4), (0.7, -0.4))
"""Fraction of a group's speed, and radians per second, for each arc."""

SPEEDS_MPS = (8.0, 4.0, 1.5, 0.5)
"""Speeds of vehicles, bicycles, pedestrians and nuScenes' other objects."""

TINY = torch.tensor(1.0e-5)

Goals = tuple[Tensor, Tensor, Tensor]
"""A goal in the agent's frame, along the axes of the ego, and from the ego."""


class ModeIntent(NamedTuple):
    """The intended goals of the agents' modes, [A, 6, 256] each."""

    static: Tensor  # what the anchors say, the same in all layers
    goals: Goals  # what the trajectories so far say


class Wrapped(nn.Module):
    """A `TransformerLayer` under the name of the published weights."""

    def __init__(self, *, cross: bool) -> None:
        super().__init__()
        self.interaction_transformer = TransformerLayer(cross=cross)

    def forward(
        self, x: Tensor, memory: Tensor | None = None, ignore: Tensor | None = None
    ) -> Tensor:
        """Map [agents, modes, 256] to the same; see `TransformerLayer`."""
        out: Tensor = self.interaction_transformer(x, memory, ignore)
        return out


class MotionFormer(nn.Module):
    """Three layers of interaction with agents, map and goals."""

    def __init__(self, config: UniadConfig, sampling: Sampling) -> None:
        super().__init__()
        self.intention_interaction_layers = Wrapped(cross=False)
        self.track_agent_interaction_layers = _readers()
        self.map_interaction_layers = _readers()
        self.bev_interaction_layers = nn.ModuleList(
            AttentionLayer(GoalAttention(config.grid, config.head_hw, sampling))
            for _ in range(LAYERS)
        )
        self.static_dynamic_fuser = mlp(2 * EMBED, 2 * EMBED, EMBED)
        self.dynamic_embed_fuser = mlp(3 * EMBED, 2 * EMBED, EMBED)
        self.in_query_fuser = mlp(2 * EMBED, 2 * EMBED, EMBED)
        self.out_query_fuser = mlp(4 * EMBED, 2 * EMBED, EMBED)

    def forward(
        self,
        layer: int,
        query: Tensor,
        intent: ModeIntent,
        agents: tuple[Tensor, Tensor, Tensor],
        lanes: Tensor,
        bev: Tensor,
        at: Tensor,
    ) -> Tensor:
        """Let the modes [A, 6, 256] read agents, lanes and the view in one layer.

        ``agents`` are track queries and positions [1, A, 256], and [1, A] bool, true in
        empty slots; ``lanes`` are queries plus positions, [1, lanes, 256]; ``bev`` is
        the upsampled view [1, cells, 256]; ``at`` [A, 6, 12, 2] are the trajectories so
        far, metres, lidar frame.
        """
        # Fuse the goals into the query
        dynamic = self.dynamic_embed_fuser(torch.cat(intent.goals, -1))
        fused = self.static_dynamic_fuser(torch.cat([intent.static, dynamic], -1))
        query = self.in_query_fuser(torch.cat([query, fused], -1))
        track, track_pos, empty = agents
        pos = track_pos[0][:, None].expand_as(query)
        asked = query + pos
        # Read agents, lanes and the view around the goal
        social = self.track_agent_interaction_layers[layer](
            asked, track + track_pos, empty
        )
        aware = self.map_interaction_layers[layer](asked, lanes)
        modes, places, ways = (x.flatten(0, 1).unsqueeze(0) for x in (query, pos, at))
        goal = self.bev_interaction_layers[layer](modes, (places, bev, ways))
        own = track[0][:, None].expand_as(query) + pos
        parts = [social, aware, goal[0].view_as(query), own]
        out: Tensor = self.out_query_fuser(torch.cat(parts, -1))
        return out


def _readers() -> nn.ModuleList:
    return nn.ModuleList(Wrapped(cross=True) for _ in range(LAYERS))


class Agents(NamedTuple):
    """Tracks in their slots, followed by the ego vehicle."""

    query: Tensor  # [1, A, 256]
    boxes: Tensor  # [A, 10], metres
    labels: Tensor  # [A] int64
    empty: Tensor  # [1, A] bool: nothing is there, or nothing is seen


class Forecasts(NamedTuple):
    """The predicted motion of all agents."""

    trajectories: Tensor  # [3, 1, A, 6, 12, 5], metres from where the agent is
    scores: Tensor  # [3, 1, A, 6], logarithms of probabilities
    modes: Tensor  # [1, A, 6, 256], queries of the last layer
    pos: Tensor  # [1, A, 256], of the agents


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


class MotionHead(nn.Module):
    """Anchors, embeddings and `MotionFormer`."""

    def __init__(self, config: UniadConfig, sampling: Sampling) -> None:
        super().__init__()
        groups = max(config.labels.groups) + 1
        self.learnable_motion_query_embedding = nn.Embedding(
            AGENT_MODES * groups, EMBED
        )
        self.motionformer = MotionFormer(config, sampling)
        # Embeddings of goals in three frames
        self.agent_level_embedding_layer = mlp(EMBED, 2 * EMBED, EMBED)
        self.scene_level_ego_embedding_layer = mlp(EMBED, 2 * EMBED, EMBED)
        self.scene_level_offset_embedding_layer = mlp(EMBED, 2 * EMBED, EMBED)
        self.boxes_query_embedding_layer = mlp(EMBED, 2 * EMBED, EMBED)
        # One branch per layer
        self.traj_cls_branches = nn.ModuleList(classifier(1) for _ in range(LAYERS))
        self.traj_reg_branches = nn.ModuleList(
            mlp(EMBED, EMBED, EMBED, AGENT_STEPS * OUTPUTS) for _ in range(LAYERS)
        )
        self.sines = PointSines(config.grid.pc_range)
        self.register_buffer("kmeans_anchors", anchors(groups))
        self.register_buffer("group_of", torch.tensor(config.labels.groups), False)

    kmeans_anchors: Tensor
    group_of: Tensor

    def forward(self, agents: Agents, lanes: Tensor, bev: Tensor) -> Forecasts:
        """Predict the motion of all agents in all modes.

        ``lanes`` are [1, lanes, 256]; ``bev`` is the upsampled view [1, cells, 256].
        """
        # Anchors and positions in the frames of the agents
        frames = AgentFrames.of(agents.boxes)
        pos = self.boxes_query_embedding_layer(self.sines(agents.boxes[:, :2]))
        pos = pos.unsqueeze(0)
        group = self.group_of[agents.labels]
        anchor = self.kmeans_anchors[group]
        offsets = frames.turned(anchor)
        goals = self._goals(anchor, offsets, offsets + frames.centre)
        # The static part of the intent
        learned = self.learnable_motion_query_embedding.weight
        learned = learned.unflatten(0, (-1, AGENT_MODES))[group]
        own = self.motionformer.intention_interaction_layers(goals[0])
        goals = (own, *goals[1:])
        static = own + goals[1] + learned
        query = torch.zeros_like(static)
        read = agents.query, pos, agents.empty
        trajectories, scores = [], []
        # Refine the trajectories layer by layer
        for layer in range(LAYERS):
            at = offsets + frames.centre
            intent = ModeIntent(static, goals)
            query = self.motionformer(layer, query, intent, read, lanes, bev, at)
            steps = self.traj_reg_branches[layer](query)
            steps = steps.unflatten(2, (AGENT_STEPS, OUTPUTS))
            offsets = steps[..., :2].cumsum(2)
            spread = [steps[..., 2:4].exp(), steps[..., 4:].tanh()]
            trajectories.append(torch.cat([offsets, *spread], -1).unsqueeze(0))
            score = self.traj_cls_branches[layer](query).squeeze(2)
            scores.append(score.log_softmax(1).unsqueeze(0))
            if layer < LAYERS - 1:
                ahead = frames.turned_back(offsets)
                goals = self._goals(ahead, offsets, offsets + frames.centre)
        return Forecasts(
            torch.stack(trajectories), torch.stack(scores), query.unsqueeze(0), pos
        )

    def _goals(self, own: Tensor, offsets: Tensor, places: Tensor) -> Goals:
        """Embed the last points of [A, 6, 12, 2] in three frames."""
        return (
            self.agent_level_embedding_layer(self.sines(own[:, :, -1])),
            self.scene_level_offset_embedding_layer(self.sines(offsets[:, :, -1])),
            self.scene_level_ego_embedding_layer(self.sines(places[:, :, -1])),
        )
