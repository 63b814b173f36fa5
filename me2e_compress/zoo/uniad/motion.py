"""The motion head of UniAD: where the agents and the ego vehicle will go."""

from torch import nn

from me2e_compress.zoo.bev.attention import FeedForward
from me2e_compress.zoo.bev.sizes import ATTENTION_HEADS, EMBED
from me2e_compress.zoo.uniad.config import AGENT_MODES, AGENT_STEPS
from me2e_compress.zoo.uniad.layers import TransformerLayer, mlp, projection

LAYERS = 3
ANCHOR_GROUPS = 3
"""Cars, vans and trucks; bicycles; pedestrians (Bench2Drive)."""

GOAL_POINTS = 4
OUTPUTS = 5
"""Mean x and y, both standard deviations, correlation."""

TRACK_LAYERS = 6


class Wrapped(nn.Module):
    """A `TransformerLayer` under the name of the published weights."""

    def __init__(self, *, cross: bool) -> None:
        super().__init__()
        self.interaction_transformer = TransformerLayer(cross=cross)


class GoalAttention(nn.Module):
    """Modes read the view around the points of their last trajectory."""

    def __init__(self) -> None:
        super().__init__()
        samples = AGENT_STEPS * ATTENTION_HEADS * GOAL_POINTS
        self.sampling_offsets = nn.Linear(EMBED, samples * 2)
        self.attention_weights = nn.Linear(EMBED, samples)
        self.value_proj = nn.Linear(EMBED, EMBED)
        self.output_proj = projection(AGENT_STEPS * EMBED, EMBED)


class GoalLayer(nn.Module):
    """`GoalAttention` and a feed-forward."""

    def __init__(self) -> None:
        super().__init__()
        self.attentions = nn.ModuleList([GoalAttention()])
        self.ffns = nn.ModuleList([FeedForward()])
        self.norms = nn.ModuleList(nn.LayerNorm(EMBED) for _ in range(2))


class MotionFormer(nn.Module):
    """Three layers of interaction with agents, map and goals."""

    def __init__(self) -> None:
        super().__init__()
        self.intention_interaction_layers = Wrapped(cross=False)
        self.track_agent_interaction_layers = _repeat(Wrapped)
        self.map_interaction_layers = _repeat(Wrapped)
        self.bev_interaction_layers = nn.ModuleList(GoalLayer() for _ in range(LAYERS))
        self.static_dynamic_fuser = mlp(2 * EMBED, 2 * EMBED, EMBED)
        self.dynamic_embed_fuser = mlp(3 * EMBED, 2 * EMBED, EMBED)
        self.in_query_fuser = mlp(2 * EMBED, 2 * EMBED, EMBED)
        self.out_query_fuser = mlp(4 * EMBED, 2 * EMBED, EMBED)


def _repeat(layer: type[Wrapped]) -> nn.ModuleList:
    return nn.ModuleList(layer(cross=True) for _ in range(LAYERS))


class MotionHead(nn.Module):
    """Anchors, embeddings, `MotionFormer`, branches.

    Args:
        dead: Hold ``layer_track_query_fuser``, which inference never reads.
    """

    def __init__(self, *, dead: bool = False) -> None:
        super().__init__()
        self.learnable_motion_query_embedding = nn.Embedding(
            AGENT_MODES * ANCHOR_GROUPS, EMBED
        )
        self.motionformer = MotionFormer()
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
