"""The planning part of the head: the path of the ego vehicle."""

import torch
from torch import Tensor, nn

from me2e_compress.zoo.bev.decoder import Interaction
from me2e_compress.zoo.bev.sizes import EMBED, Sampling
from me2e_compress.zoo.regions import region
from me2e_compress.zoo.vad.config import AGENT_MODES, STEPS, Heads, VadConfig
from me2e_compress.zoo.vad.motion import MotionHead, MotionOutputs
from me2e_compress.zoo.vad.perception import AgentOutputs, regressor

Outputs = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


class PlanningHead(MotionHead):
    """The whole head: the ego query attends to the agents, then to the map."""

    def __init__(self, heads: Heads, sampling: Sampling, config: VadConfig) -> None:
        super().__init__(heads, sampling, config)
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
        self.ego_fut_decoder = regressor(heads.ego_modes * STEPS * 2, 2 * EMBED)

    def forward(
        self, features: Tensor, lidar2img: Tensor, can_bus: Tensor, prev_bev: Tensor
    ) -> Outputs:
        """Map camera features [cameras, 256, h, w] to all outputs of the stack."""
        bev, agents, vectors = self.perceive(features, lidar2img, can_bus, prev_bev)
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
