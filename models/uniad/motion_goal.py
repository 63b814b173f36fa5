"""Attention of an agent's modes to the view around their trajectories."""

import torch
from torch import Tensor, nn

from models.bev.attention import deformable_attention
from models.bev.layers import projection
from models.bev.sizes import ATTENTION_HEADS, EMBED, BevGrid, Sampling
from models.uniad.config import AGENT_STEPS

GOAL_POINTS = 4


class GoalAttention(nn.Module):
    """Four samples per head around each of the twelve points of a trajectory."""

    def __init__(self, grid: BevGrid, hw: tuple[int, int], sampling: Sampling) -> None:
        super().__init__()
        self.hw = hw
        self.sampling: Sampling = sampling
        samples = AGENT_STEPS * ATTENTION_HEADS * GOAL_POINTS
        self.sampling_offsets = nn.Linear(EMBED, samples * 2)
        self.attention_weights = nn.Linear(EMBED, samples)
        self.value_proj = nn.Linear(EMBED, EMBED)
        self.output_proj = projection(AGENT_STEPS * EMBED, EMBED)
        low, high = torch.tensor(grid.pc_range[:2]), torch.tensor(grid.pc_range[3:5])
        self.register_buffer("low", low, False)
        self.register_buffer("extent", high - low, False)
        self.register_buffer("size_xy", torch.tensor(hw[::-1]).float(), False)

    low: Tensor
    extent: Tensor
    size_xy: Tensor

    def forward(self, query: Tensor, pos: Tensor, bev: Tensor, at: Tensor) -> Tensor:
        """Map queries [1, Q, 256], one per agent and mode, to [1, Q, 256].

        ``bev`` is [1, cells, 256] and ``at`` [1, Q, 12, 2], metres in the ego frame.
        """
        asked = query + pos
        heads, steps, points = ATTENTION_HEADS, AGENT_STEPS, GOAL_POINTS
        value = self.value_proj(bev).unflatten(2, (heads, -1))
        # Offsets and weights for every point of the trajectory
        offsets = self.sampling_offsets(asked)
        offsets = offsets.unflatten(2, (heads, steps, 1, points, 2))
        weights = self.attention_weights(asked).unflatten(2, (heads, steps, points))
        weights = weights.softmax(-1).unsqueeze(4)
        # Sample the points, then join them
        places = ((at - self.low) / self.extent)[:, :, None, :, None, None]
        locations = places + offsets / self.size_xy
        read = deformable_attention(
            value,
            (self.hw,),
            locations.permute(0, 1, 3, 2, 4, 5, 6).flatten(1, 2),
            weights.permute(0, 1, 3, 2, 4, 5).flatten(1, 2),
            self.sampling,
        )
        joined = read.unflatten(1, (-1, steps)).flatten(2)
        out: Tensor = query + self.output_proj(joined)
        return out
