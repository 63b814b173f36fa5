"""The occupancy head of UniAD: the cells that the agents will occupy."""

import torch
from torch import Tensor, nn

from models.bev.attention import MultiheadAttention
from models.bev.layers import AttentionLayer, projection
from models.bev.sizes import EMBED, Sampling
from models.uniad.config import UniadConfig
from models.uniad.motion import Agents, Forecasts
from models.uniad.occ_images import (
    AreaSampler,
    DenseDecoder,
    Downscale,
    LightProjection,
    UpsamplingAdd,
    halved,
)

FUTURES = 5
"""Now and four steps of 0.5 s."""

WIDE_FEED_FORWARD = 2048
"""Four times as wide as elsewhere."""
REACH = 0.5
"""Cells of at least this probability belong to an instance."""


class StateDecoder(nn.Module):
    """A layer per step, in which cells attend to cells, then to their instances.

    The normalisation is never applied here.
    """

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            AttentionLayer(
                MultiheadAttention(), MultiheadAttention(), hidden=WIDE_FEED_FORWARD
            )
            for _ in range(FUTURES)
        )
        self.post_norm = nn.LayerNorm(EMBED)

    def forward(
        self, step: int, x: Tensor, instances: Tensor, ignore: Tensor
    ) -> Tensor:
        """Map cells [1, cells, 256] and instances [1, A, 256] to [1, cells, 256].

        ``ignore`` is [1, cells, A] bool.
        """
        out: Tensor = self.layers[step](x, (x,), (instances, None, None, ignore))
        return out


class Layered(nn.Module):
    """Linear layers with ReLUs between them, under their published names."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(EMBED, EMBED) for _ in range(count))

    def forward(self, x: Tensor) -> Tensor:
        """Map [..., 256] to [..., 256]."""
        for index, layer in enumerate(self.layers):
            x = layer(torch.relu(x) if index else x)
        return x


class OccHead(nn.Module):
    """Maps the view and the agents to occupancy probabilities of cells."""

    def __init__(self, config: UniadConfig, sampling: Sampling) -> None:
        super().__init__()
        self.hw = config.head_hw
        half = halved(self.hw)
        self.state_hw = halved(half)
        self.small_hw = halved(self.state_hw)
        # From the view to the small state
        self.bev_sampler = AreaSampler(config.grid, self.hw, sampling)
        self.bev_light_proj = LightProjection()
        self.base_downscale = nn.Sequential(Downscale(self.hw), Downscale(half))
        # One set of layers per step
        self.transformer_decoder = StateDecoder()
        self.temporal_mlps = nn.ModuleList(Layered(2) for _ in range(FUTURES))
        self.downscale_convs = nn.ModuleList(
            Downscale(self.state_hw) for _ in range(FUTURES)
        )
        self.upsample_adds = nn.ModuleList(
            UpsamplingAdd(self.state_hw) for _ in range(FUTURES)
        )
        self.dense_decoder = DenseDecoder(self.state_hw)
        # From agents to mask queries
        self.mode_fuser = projection(EMBED, EMBED)
        self.multi_query_fuser = nn.Sequential(
            *projection(3 * EMBED, 2 * EMBED), nn.Linear(2 * EMBED, EMBED)
        )
        self.query_to_occ_feat = Layered(3)
        self.temporal_mlp_for_mask = Layered(3)
        vehicles = config.labels.vehicles
        is_vehicle = [each in vehicles for each in range(config.labels.classes)]
        self.register_buffer("is_vehicle", torch.tensor(is_vehicle), False)

    is_vehicle: Tensor

    def forward(
        self, bev: Tensor, agents: Agents, motion: Forecasts, scores: Tensor
    ) -> Tensor:
        """Predict the occupancy by all agents except the ego, [1, 5, rows, columns].

        It is the probability times the score of the occupying track. ``bev`` is the
        upsampled view [1, cells, 256], ``scores`` [A] those of tracks; empty slots and
        other classes than vehicles occupy nothing.
        """
        # Shrink the view; hide empty slots and other classes
        state = self.base_downscale(self.bev_light_proj(self.bev_sampler(bev)))
        hidden = agents.empty[:, :-1] | torch.logical_not(
            self.is_vehicle[agents.labels[:-1]]
        )
        # One query per agent
        instances = self.mode_fuser(motion.modes[:, :-1]).amax(2)
        parts = [instances, agents.query[:, :-1], motion.pos[:, :-1]]
        instances = self.multi_query_fuser(torch.cat(parts, -1))
        states, embeddings = [], []
        # Advance the state step by step
        for step in range(FUTURES):
            asked = self.temporal_mlps[step](instances)
            state, embedding = self._step(step, state, asked, hidden)
            states.append(state)
            embeddings.append(embedding)
        # Occupancy is the product of masks and dense features
        dense = self.dense_decoder(torch.cat(states))
        dense = dense[:, :, : self.hw[0], : self.hw[1]].flatten(2)
        masks = self.query_to_occ_feat(torch.cat(embeddings))
        taken = torch.matmul(masks, dense).sigmoid()
        weight = scores * torch.logical_not(hidden[0]).to(scores.dtype)
        taken = (taken * weight.view(1, -1, 1)).amax(1)
        cells: Tensor = taken.unflatten(1, self.hw).unsqueeze(0)
        return cells

    def _step(
        self, step: int, state: Tensor, asked: Tensor, hidden: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return a step's state [1, 256, h, w] and mask queries [1, A, 256]."""
        small = self.downscale_convs[step](state)
        embedding = self.temporal_mlp_for_mask(asked)
        cells = small.flatten(2).transpose(1, 2)
        # Cells attend only to instances whose mask holds them
        mine = torch.matmul(cells, embedding.transpose(1, 2)).sigmoid() >= REACH
        mine = mine & torch.logical_not(hidden).unsqueeze(1)
        ignore = torch.logical_not(mine) & mine.any(2, keepdim=True)
        ignore = ignore | hidden.unsqueeze(1)
        cells = self.transformer_decoder(step, cells, asked, ignore)
        image = cells.transpose(1, 2).unflatten(2, self.small_hw)
        return self.upsample_adds[step](image, state), embedding
