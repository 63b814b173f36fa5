"""Futures of the agents."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from models.driver.network.blocks import DecoderLayer, mlp
from models.driver.network.config import STEP_S, STEPS, HighwayConfig
from models.driver.network.map import RoadMap
from models.driver.network.track import Tracks


@dataclass
class Futures:
    """Outputs of the motion module.

    Attributes:
        query: [B, A, C].
        travel: [B, A, M, 6, 2] metres from where the agent is now, in the axes of the
            ego, every 0.5 s.
        logits: [B, A, M] of the modes.
    """

    query: Tensor
    travel: Tensor
    logits: Tensor


class Motion(nn.Module):
    """Agents in several modes attend to each other and to the routes (VAD)."""

    times: Tensor

    def __init__(self, config: HighwayConfig) -> None:
        super().__init__()
        channels = config.channels
        self.agents, self.modes = config.agents, config.modes
        self.mode = nn.Parameter(torch.randn(1, 1, self.modes, channels) * 0.5)
        self.box = mlp(8, channels, channels)
        self.layer = DecoderLayer(channels, config.heads)
        self.travel = mlp(channels, 2 * channels, STEPS * 2)
        self.logit = nn.Linear(channels, 1)
        self.merge = nn.Linear(self.modes * channels, channels)
        times = STEP_S * torch.arange(1, STEPS + 1)
        self.register_buffer("times", times[:, None], False)

    def forward(self, tracks: Tracks, road: RoadMap) -> Futures:
        """Predict."""
        boxes = tracks.boxes.detach()
        query = tracks.query + self.box(boxes / 10)
        query = (query[:, :, None] + self.mode).flatten(1, 2)
        query = self.layer(query, road.query, road.query)
        query = query.unflatten(1, (self.agents, self.modes))
        drift = boxes[:, :, None, None, 6:8] * self.times
        travel = self.travel(query).float().unflatten(-1, (STEPS, 2)) + drift
        merged = self.merge(query.flatten(2))
        return Futures(merged, travel, self.logit(query).squeeze(-1).float())
