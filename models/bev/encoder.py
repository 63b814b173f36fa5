"""Encode camera features and the previous BEV to a bird's eye view (BEVFormer)."""

import torch
from torch import Tensor, nn

from models.bev.attention import Levels, deformable_attention
from models.bev.layers import AttentionLayer
from models.bev.reference_points import cell_centres, pillars, project
from models.bev.sizes import (
    ATTENTION_HEADS,
    EMBED,
    PILLAR_POINTS,
    BevGrid,
    Sampling,
)


class TemporalSelfAttention(nn.Module):
    """BEV queries attend to the previous BEV and the current queries."""

    points = 4
    queue = 2

    def __init__(self, hw: tuple[int, int], sampling: Sampling) -> None:
        super().__init__()
        self.hw = hw
        self.sampling: Sampling = sampling
        samples = self.queue * ATTENTION_HEADS * self.points
        self.sampling_offsets = nn.Linear(self.queue * EMBED, samples * 2)
        self.attention_weights = nn.Linear(self.queue * EMBED, samples)
        self.value_proj = nn.Linear(EMBED, EMBED)
        self.output_proj = nn.Linear(EMBED, EMBED)
        self.register_buffer("size_xy", torch.tensor(hw[::-1]).float(), False)

    def forward(self, query: Tensor, pos: Tensor, queue: Tensor, at: Tensor) -> Tensor:
        """Map queries [1, cells, 256] to [1, cells, 256], with the residual.

        ``pos`` [1, cells, 256] is added to the query; ``queue`` [2, cells, 256] is the
        previous BEV and the current one; ``at`` [1, cells, 2] are reference points,
        0..1.
        """
        # Offsets and weights come from both BEVs
        asked = torch.cat([queue[:1], query + pos], -1)
        cells = asked.shape[1]
        heads, points = ATTENTION_HEADS, self.points
        value = self.value_proj(queue).view(self.queue, cells, heads, -1)
        offsets = self.sampling_offsets(asked)
        offsets = offsets.view(1, cells, heads, self.queue, 1, points, 2)
        offsets = offsets.permute(0, 3, 1, 2, 4, 5, 6).flatten(0, 1)
        weights = self.attention_weights(asked)
        weights = weights.view(1, cells, heads, self.queue, points).softmax(-1)
        weights = weights.permute(0, 3, 1, 2, 4).flatten(0, 1).unsqueeze(3)
        # Sample both, then average
        locations = at[:, :, None, None, None, :] + offsets / self.size_xy
        hws = (self.hw,)
        out = deformable_attention(value, hws, locations, weights, self.sampling)
        read: Tensor = self.output_proj(out.mean(0, keepdim=True))
        return query + read


class CameraAttention(nn.Module):
    """The deformable attention within `SpatialCrossAttention`."""

    points = 8

    def __init__(self, hws: Levels, sampling: Sampling) -> None:
        super().__init__()
        self.hws = hws
        self.sampling: Sampling = sampling
        samples = ATTENTION_HEADS * len(hws) * self.points
        self.sampling_offsets = nn.Linear(EMBED, samples * 2)
        self.attention_weights = nn.Linear(EMBED, samples)
        self.value_proj = nn.Linear(EMBED, EMBED)
        sizes = torch.tensor([hw[::-1] for hw in hws]).float()
        size_xy = sizes[0] if len(hws) == 1 else sizes[:, None]
        self.register_buffer("size_xy", size_xy, False)

    def forward(self, query: Tensor, tokens: Tensor, at: Tensor) -> Tensor:
        """Read every camera for every cell, visible or not: [cameras, cells, 256].

        ``query`` is [1, cells, 256], ``tokens`` [cameras, tokens of all levels, 256]
        and ``at`` [cameras, cells, pillar points, 2] in the image, 0..1.
        """
        heads, points, levels = ATTENTION_HEADS, self.points, len(self.hws)
        cameras, cells = at.shape[:2]
        value = self.value_proj(tokens).view(cameras, tokens.shape[1], heads, -1)
        # Each pillar point has an equal share of the samples
        offsets = self.sampling_offsets(query)
        offsets = offsets.view(1, cells, heads, levels, points, 2)
        groups = levels * points // PILLAR_POINTS
        offsets = (offsets / self.size_xy).view(
            1, cells, heads, groups, PILLAR_POINTS, 2
        )
        # Weights are the same for all cameras
        weights = self.attention_weights(query).view(1, cells, heads, levels * points)
        weights = _by_level(weights.softmax(-1), levels)
        weights = weights.expand(cameras, cells, heads, levels, points)
        locations = at[:, :, None, None] + offsets
        locations = locations.view(cameras, cells, heads, levels, points, 2)
        return deformable_attention(value, self.hws, locations, weights, self.sampling)


def _by_level(weights: Tensor, levels: int) -> Tensor:
    return weights.unsqueeze(3) if levels == 1 else weights.unflatten(3, (levels, -1))


ONE = torch.tensor(1.0)


class SpatialCrossAttention(nn.Module):
    """BEV queries attend to the cameras in which their pillar is visible."""

    def __init__(self, hws: Levels, sampling: Sampling) -> None:
        super().__init__()
        self.deformable_attention = CameraAttention(hws, sampling)
        self.output_proj = nn.Linear(EMBED, EMBED)

    def forward(
        self, query: Tensor, tokens: Tensor, at: Tensor, visible: Tensor
    ) -> Tensor:
        """Attend as `CameraAttention`, averaged over cameras that see the cell.

        ``visible`` is [cameras, cells, 1] float32, 1 or 0.
        """
        seen = self.deformable_attention(query, tokens, at) * visible
        count = torch.maximum(visible.sum(0, keepdim=True), ONE)
        read: Tensor = self.output_proj(seen.sum(0, keepdim=True) / count)
        return query + read


class BevEncoder(nn.Module):
    """Layers of temporal and camera attention over a grid.

    ``hws`` are the feature levels of a camera.
    """

    pillars: Tensor
    cells: Tensor

    def __init__(
        self,
        grid: BevGrid,
        image_hw: tuple[int, int],
        hws: Levels,
        layers: int,
        sampling: Sampling,
    ) -> None:
        super().__init__()
        self.image_hw = image_hw
        self.layers = nn.ModuleList(
            AttentionLayer(
                TemporalSelfAttention(grid.hw, sampling),
                SpatialCrossAttention(hws, sampling),
            )
            for _ in range(layers)
        )
        # Constant reference points
        points = pillars(grid.hw, grid.pc_range, PILLAR_POINTS)
        self.register_buffer("pillars", points, False)
        self.register_buffer("cells", cell_centres(grid.hw), False)

    def forward(
        self,
        query: Tensor,
        pos: Tensor,
        previous: Tensor,
        first: Tensor,
        shift: Tensor,
        tokens: Tensor,
        lidar2img: Tensor,
    ) -> Tensor:
        """Encode one frame, query and pos [1, cells, 256], to [1, cells, 256].

        ``previous`` [1, cells, 256] is the last BEV turned to the current heading,
        ``tokens`` [cameras, h * w, 256], ``lidar2img`` [1, cameras, 4, 4]. The bool
        ``first`` says that there is no previous BEV. As in the original, ``shift`` [1,
        2], the ego translation relative to the grid, moves the reference points of both
        halves of the queue.
        """
        # Project the pillars and shift the cells once per frame
        pillars_at, visible = project(self.pillars, lidar2img, self.image_hw)
        cells_at = self.cells + shift[:, None]
        start = query
        for layer in self.layers:
            # Without a previous view, queries attend to themselves
            older = torch.where(first, query, previous)
            newer = torch.where(first, query, start)
            queue = torch.cat([older, newer], 0)
            query = layer(query, (pos, queue, cells_at), (tokens, pillars_at, visible))
        return query


class GridPosition(nn.Module):
    """Learned embedding of rows and columns."""

    def __init__(self, hw: tuple[int, int]) -> None:
        super().__init__()
        self.hw = hw
        self.row_embed = nn.Embedding(hw[0], EMBED // 2)
        self.col_embed = nn.Embedding(hw[1], EMBED // 2)

    def forward(self) -> Tensor:
        """Return [1, cells, 256]: column half, then row half."""
        height, width = self.hw
        columns = self.col_embed.weight.unsqueeze(0).expand(height, -1, -1)
        rows = self.row_embed.weight.unsqueeze(1).expand(-1, width, -1)
        return torch.cat([columns, rows], -1).flatten(0, 1).unsqueeze(0)
