"""The motion head of UniAD: where the agents and the ego vehicle will go."""

import torch
from torch import Tensor, nn

from me2e_compress.zoo.bev.sizes import EMBED, Sampling
from me2e_compress.zoo.uniad.config import AGENT_MODES, AGENT_STEPS, UniadConfig
from me2e_compress.zoo.uniad.layers import TransformerLayer, mlp, projection
from me2e_compress.zoo.uniad.motion_goal import GoalLayer

LAYERS = 3
ANCHOR_GROUPS = 3
"""Cars, vans and trucks; bicycles; pedestrians (Bench2Drive)."""

OUTPUTS = 5
"""Mean x and y, both standard deviations, correlation."""

TRACK_LAYERS = 6


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
        self.track_agent_interaction_layers = _repeat(Wrapped)
        self.map_interaction_layers = _repeat(Wrapped)
        self.bev_interaction_layers = nn.ModuleList(
            GoalLayer(config.grid, config.head_hw, sampling) for _ in range(LAYERS)
        )
        self.static_dynamic_fuser = mlp(2 * EMBED, 2 * EMBED, EMBED)
        self.dynamic_embed_fuser = mlp(3 * EMBED, 2 * EMBED, EMBED)
        self.in_query_fuser = mlp(2 * EMBED, 2 * EMBED, EMBED)
        self.out_query_fuser = mlp(4 * EMBED, 2 * EMBED, EMBED)

    def mix(
        self,
        layer: int,
        query: Tensor,
        agents: tuple[Tensor, Tensor, Tensor],
        lanes: tuple[Tensor, Tensor],
        bev: Tensor,
        at: Tensor,
    ) -> Tensor:
        """Let the modes of a layer read agents, lanes and the view.

        Args:
            layer: Which.
            query: [A, 6, 256].
            agents: Track queries [1, A, 256], their positions [1, A, 256], and where a
                slot holds no agent [1, A] bool.
            lanes: Lane queries and their positions, [1, lanes, 256] each.
            bev: [1, cells, 256], the enlarged view.
            at: [A, 6, 12, 2], the trajectories so far, metres.

        Returns:
            [A, 6, 256].
        """
        track, track_pos, empty = agents
        pos = track_pos[0][:, None].expand_as(query)
        asked = query + pos
        social = self.track_agent_interaction_layers[layer](
            asked, track + track_pos, empty
        )
        aware = self.map_interaction_layers[layer](asked, lanes[0] + lanes[1])
        flat = [x.flatten(0, 1).unsqueeze(0) for x in (query, pos, at)]
        goal = self.bev_interaction_layers[layer](flat[0], flat[1], bev, flat[2])
        own = track[0][:, None].expand_as(query) + pos
        parts = [social, aware, goal[0].view_as(query), own]
        out: Tensor = self.out_query_fuser(torch.cat(parts, -1))
        return out


def _repeat(layer: type[Wrapped]) -> nn.ModuleList:
    return nn.ModuleList(layer(cross=True) for _ in range(LAYERS))


class MotionHead(nn.Module):
    """Anchors, embeddings, `MotionFormer`, branches.

    Args:
        config: Sizes.
        sampling: See `sample`.
        dead: Hold ``layer_track_query_fuser``, which inference never reads.
    """

    def __init__(
        self, config: UniadConfig, sampling: Sampling, *, dead: bool = False
    ) -> None:
        super().__init__()
        self.learnable_motion_query_embedding = nn.Embedding(
            AGENT_MODES * ANCHOR_GROUPS, EMBED
        )
        self.motionformer = MotionFormer(config, sampling)
        self.agent_level_embedding_layer = mlp(EMBED, 2 * EMBED, EMBED)
        self.scene_level_ego_embedding_layer = mlp(EMBED, 2 * EMBED, EMBED)
        self.scene_level_offset_embedding_layer = mlp(EMBED, 2 * EMBED, EMBED)
        self.boxes_query_embedding_layer = mlp(EMBED, 2 * EMBED, EMBED)
        self.traj_cls_branches = nn.ModuleList(
            nn.Sequential(
                *projection(EMBED, EMBED),
                *projection(EMBED, EMBED),
                nn.Linear(EMBED, 1),
            )
            for _ in range(LAYERS)
        )
        self.traj_reg_branches = nn.ModuleList(
            mlp(EMBED, EMBED, EMBED, AGENT_STEPS * OUTPUTS) for _ in range(LAYERS)
        )
        if dead:
            self.layer_track_query_fuser = projection(TRACK_LAYERS * EMBED, EMBED)
