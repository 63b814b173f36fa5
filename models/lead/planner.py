"""The plan: queries that read the bird's eye view and the state of the vehicle."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from models.lead.config import (
    COMMANDS,
    MAX_SPEED_MPS,
    TARGET_POINT_M,
    TARGET_POINTS,
    TARGET_SPEEDS_MPS,
    LeadConfig,
)

STATUS_TOKENS = 2 + len(TARGET_POINTS)
"""Speed, command and target points."""

TEMPERATURE = 10_000.0
"""Of the sines of a place (Carion et al. 2020)."""


class PositionEmbeddingSine(nn.Module):
    """Sines and cosines of a cell's row and column."""

    def forward(self, x: Tensor) -> Tensor:
        """Return [1, C, h, w] for a map of that size."""
        half = x.shape[1] // 2
        ones = torch.ones_like(x[:, 0])
        rates = torch.arange(half, dtype=torch.float32)
        rates = TEMPERATURE ** (2 * torch.div(rates, 2, rounding_mode="floor") / half)
        parts = []
        for axis in (1, 2):
            at = ones.cumsum(axis, dtype=torch.float32)
            last = at[:, -1:, :] if axis == 1 else at[:, :, -1:]
            turns = (at / (last + 1e-6) * (2 * math.pi))[..., None] / rates
            waves = turns[..., 0::2].sin(), turns[..., 1::2].cos()
            parts.append(torch.stack(waves, 4).flatten(3))
        return torch.cat(parts, 3).permute(0, 3, 1, 2)


class PlanningContextEncoder(nn.Module):
    """Makes tokens of the bird's eye view and of the vehicle's state."""

    def __init__(self, channels: int, config: LeadConfig) -> None:
        super().__init__()
        width = config.token
        self.velocity_encoder = nn.Sequential(nn.Linear(1, width))
        self.command_encoder = nn.Sequential(nn.Linear(COMMANDS, width))
        self.tp_encoder = nn.Linear(2, width)
        self.cosine_pos_embeding = PositionEmbeddingSine()
        self.status_pos_embedding = nn.Parameter(torch.zeros(1, STATUS_TOKENS, width))
        self.dimension_adapter = nn.Conv2d(channels, width, 1)

    def forward(
        self, bev: Tensor, speed: Tensor, command: Tensor, points: Sequence[Tensor]
    ) -> Tensor:
        """Map [1, 512, 10, 12] and the state to tokens [1, 120 + 5, 256]."""
        cells = self.dimension_adapter(bev)
        cells = cells + self.cosine_pos_embeding(cells)
        # One token for each number or point of the state
        scale = cells.new_tensor(TARGET_POINT_M)
        tokens = [
            self.velocity_encoder(speed.view(1, 1) / MAX_SPEED_MPS),
            self.command_encoder(command),
            *(self.tp_encoder(point / scale) for point in points),
        ]
        status = torch.stack(tokens, 1) + self.status_pos_embedding
        return torch.cat([cells.flatten(2).permute(0, 2, 1), status], 1)


class PlanningDecoder(nn.Module):
    """Decodes route, waypoints and target speed."""

    def __init__(self, channels: int, config: LeadConfig) -> None:
        super().__init__()
        width = config.token
        self.sizes = config.route, config.waypoints, 1
        self.planning_context_encoder = PlanningContextEncoder(channels, config)
        self.query = nn.Parameter(torch.zeros(1, sum(self.sizes), width))
        layer = nn.TransformerDecoderLayer(
            width,
            config.planner_heads,
            config.feed_forward,
            activation=nn.GELU(),
            batch_first=True,
        )
        self.transformer_decoder = nn.TransformerDecoder(
            layer, config.planner_layers, nn.LayerNorm(width)
        )
        self.route_decoder, self.wp_decoder = nn.Linear(width, 2), nn.Linear(width, 2)
        self.target_speed_decoder = nn.Sequential(
            nn.Linear(width, width), nn.ReLU(), nn.Linear(width, len(TARGET_SPEEDS_MPS))
        )

    def forward(
        self, bev: Tensor, speed: Tensor, command: Tensor, points: Sequence[Tensor]
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return what drives.

        Returns:
            Route [1, 10, 2] and waypoints [1, 8, 2], metres; logits of the target
            speeds [1, 8], and their mean [1], m/s.
        """
        context = self.planning_context_encoder(bev, speed, command, points)
        queries = self.transformer_decoder(self.query, context)
        route, waypoints, last = queries.split(self.sizes, 1)
        logits = self.target_speed_decoder(last[:, 0])
        speeds = logits.new_tensor(TARGET_SPEEDS_MPS)
        return (
            self.route_decoder(route).cumsum(1),
            self.wp_decoder(waypoints).cumsum(1),
            logits,
            (logits.softmax(-1) * speeds).sum(-1),
        )
