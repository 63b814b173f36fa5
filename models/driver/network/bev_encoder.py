"""Camera features to a bird's-eye view with a recurrent memory."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from models.driver.network.bev_grid import cell_centres, grid_of
from models.driver.network.blocks import Residual, conv_block, mlp, sample
from models.driver.network.config import CAMERAS, HighwayConfig

NEAREST_M = 0.3
"""A point nearer to the image plane than this is not seen."""
VIEWS = 2
"""Neighbouring views overlap: no cell of the ground is in more than two of six."""
REACH = 0.2
"""How far an offset reaches, in half images."""
SATURATION = 5.0
"""A cell seen for a fifth of the memory's time constant counts as remembered."""
RECORD = 2
"""Channels of the memory beside the features: how much of a cell was ever seen, and
that times how long ago, seconds. Without the age a displacement is no velocity."""


@dataclass
class EgoMotion:
    """How the ego moved since the last frame.

    Attributes:
        shift: [B, 2] metres, in the ego frame of the last frame.
        turn: [B] radians, counter-clockwise.
        elapsed_s: [B] seconds.
    """

    shift: Tensor
    turn: Tensor
    elapsed_s: Tensor


class SpatialCrossAttention(nn.Module):
    """Deformable attention of cells to the six images (Li et al., BEVFormer, 2022).

    A cell's pillar is projected into every camera; each head looks up one point a
    height, moved by an offset that the query asks for, and a mean is taken over the
    two cameras that see most of the pillar.
    """

    size: Tensor
    pillar: Tensor

    def __init__(self, config: HighwayConfig) -> None:
        super().__init__()
        channels, self.heads = config.channels, config.heads
        self.points = len(config.heights_m)
        self.offsets = nn.Linear(channels, self.heads * self.points * 2)
        self.weights = nn.Linear(channels, self.heads * self.points)
        self.value = nn.Conv2d(channels, channels, 1)
        self.output = nn.Linear(channels, channels)
        rows, columns = config.image_size
        self.register_buffer("size", torch.tensor([columns, rows]).float(), False)
        centres = cell_centres(config.area)
        height = torch.tensor(config.heights_m)
        pillar = torch.cat(
            [
                centres[:, None].expand(-1, self.points, -1),
                height[None, :, None].expand(len(centres), -1, -1),
                torch.ones(len(centres), self.points, 1),
            ],
            -1,
        )
        self.register_buffer("pillar", pillar.reshape(1, 1, -1, 4), False)

    def project(self, lidar2img: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Find each pillar in the two cameras that see most of it.

        Args:
            lidar2img: [B, 6, 4, 4].

        Returns:
            (pixels [B, 2, N, P, 2] in [-1, 1] of an image, cameras [B, 2, N],
            who is seen [B, 2, N, P], 1 or 0).
        """
        with torch.autocast(lidar2img.device.type, enabled=False):
            seen = torch.matmul(self.pillar, lidar2img.transpose(-1, -2))
        depth = seen[..., 2:3]
        uv = seen[..., :2] / depth.clamp(min=NEAREST_M) / self.size * 2 - 1
        inside = (depth > NEAREST_M) & (uv.abs() < 1).all(-1, keepdim=True)
        shape = (*uv.shape[:2], -1, self.points)
        uv, inside = uv.reshape(*shape, 2), inside.reshape(*shape).float()
        _, camera = inside.sum(-1).topk(VIEWS, dim=1)
        pick = camera[..., None].expand(-1, -1, -1, self.points)
        pixels = uv.gather(1, pick[..., None].expand(-1, -1, -1, -1, 2))
        return pixels, camera, inside.gather(1, pick)

    def forward(self, query: Tensor, features: Tensor, lidar2img: Tensor) -> Tensor:
        """Attend from the cells to the images.

        Args:
            query: [1, N, C].
            features: [B * 6, C, H, W].
            lidar2img: [B, 6, 4, 4].

        Returns:
            [B, N, C].
        """
        pixels, camera, seen = self.project(lidar2img)
        offsets = self.offsets(query).unflatten(-1, (self.heads, self.points, 2))
        offsets = offsets.float().tanh().permute(0, 2, 1, 3, 4) * REACH
        where = pixels[:, None] + offsets[:, :, None]
        weights = self.weights(query).unflatten(-1, (self.heads, self.points))
        weights = weights.float().softmax(-1).permute(0, 2, 1, 3)
        mask = weights[:, :, None] * seen[:, None]
        mask = mask / mask.sum((2, 4), keepdim=True).clamp(min=0.05)
        atlas, grid = self._side_by_side(features, where, camera)
        found = sample(atlas, grid).unflatten(0, (-1, self.heads))
        mask = mask.transpose(2, 3).flatten(3)[:, :, None]
        mixed = (found * mask.to(found.dtype)).sum(-1).flatten(1, 2)
        cells: Tensor = self.output(mixed.transpose(1, 2))
        return cells

    def _side_by_side(
        self, features: Tensor, where: Tensor, camera: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Put the six images next to each other, so that one look-up finds any.

        Args:
            features: [B * 6, C, H, W].
            where: [B, heads, 2, N, P, 2] in [-1, 1] of an image.
            camera: [B, 2, N].

        Returns:
            ([B * heads, C / heads, H, 6 W], [B * heads, N, 2 P, 2] in [-1, 1]).
        """
        width = features.shape[-1]
        value = self.value(features).unflatten(0, (-1, CAMERAS))
        value = value.unflatten(2, (self.heads, -1)).permute(0, 2, 3, 4, 1, 5)
        edge = 1 - 1 / width
        across = where[..., 0].clamp(-edge, edge) + 1
        across = (across + 2 * camera[:, None, :, :, None]) / CAMERAS - 1
        grid = torch.stack([across, where[..., 1]], -1).transpose(2, 3)
        return value.flatten(4).flatten(0, 1), grid.flatten(3, 4).flatten(0, 1)


class BevEncoder(nn.Module):
    """Deformable look-up, memory of the frames before, convolutions."""

    centres: Tensor

    def __init__(self, config: HighwayConfig) -> None:
        super().__init__()
        self.area, channels = config.area, config.channels
        self.memory_s = config.memory_s
        self.queries = nn.Parameter(torch.randn(1, self.area.cells, channels) * 0.1)
        self.cross = SpatialCrossAttention(config)
        self.norms = nn.ModuleList([nn.LayerNorm(channels) for _ in range(2)])
        self.ffn = mlp(channels, 2 * channels, channels)
        self.temporal = nn.Sequential(
            conv_block(2 * channels + RECORD, channels, 1), Residual(channels, channels)
        )
        self.spatial = Residual(channels, channels)
        self.place = nn.Parameter(torch.randn(1, self.area.cells, channels) * 0.1)
        self.register_buffer("centres", cell_centres(self.area), False)

    def forward(
        self,
        features: Tensor,
        lidar2img: Tensor,
        can_bus: Tensor,
        elapsed_s: Tensor,
        prev_bev: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Encode one frame.

        Args:
            features: [B * 6, C, H, W].
            lidar2img: [B, 6, 4, 4].
            can_bus: [B, 18], see the policy contract.
            elapsed_s: [B] since the last frame.
            prev_bev: [B, N, C + 2].

        Returns:
            ([B, C, rows, columns], the same as [B, N, C] with the place of each cell,
            [B, N, C + 2] to keep).
        """
        now = self.look(features, lidar2img)
        recalled = self.recall(prev_bev, motion_of(can_bus, elapsed_s))
        joined, kept = self.remember(now, recalled, elapsed_s)
        bev = self.fuse(joined)
        return bev, self.tokens(bev), kept

    def tokens(self, bev: Tensor) -> Tensor:
        """Turn [B, C, rows, columns] into tokens [B, N, C] with a learned position."""
        return bev.flatten(2).transpose(1, 2) + self.place

    def look(self, features: Tensor, lidar2img: Tensor) -> Tensor:
        """Read the cameras for every cell: [B, C, rows, columns]."""
        cells = self.cross(self.norms[0](self.queries), features, lidar2img)
        cells = self.queries + cells
        cells = cells + self.ffn(self.norms[1](cells))
        shape = (self.area.rows, self.area.columns)
        seen: Tensor = cells.transpose(1, 2).unflatten(2, shape)
        return seen

    def recall(self, prev_bev: Tensor, motion: EgoMotion) -> Tensor:
        """Warp the memory [B, N, C + 2] to here: [B, C + 2, rows, columns]."""
        cos, sin = motion.turn.cos()[:, None], motion.turn.sin()[:, None]
        x, y = self.centres[None, :, 0], self.centres[None, :, 1]
        there = torch.stack([cos * x - sin * y, sin * x + cos * y], -1)
        grid = grid_of(there + motion.shift[:, None], self.area)
        shape = (self.area.rows, self.area.columns)
        old = prev_bev.transpose(1, 2).unflatten(2, shape)
        return sample(old, grid.unflatten(1, shape))

    def remember(
        self, now: Tensor, recalled: Tensor, elapsed_s: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Blend what is seen into the memory, by time and not by frames.

        Args:
            now: [B, C, rows, columns].
            recalled: [B, C + 2, rows, columns], see `RECORD`.
            elapsed_s: [B].

        Returns:
            ([B, 2 C + 2, rows, columns] for `fuse`, [B, N, C + 2] to keep).
        """
        mass, aged = recalled[:, -2:-1], recalled[:, -1:]
        elapsed = elapsed_s[:, None, None, None]
        aged = aged + mass * elapsed
        share = mass.clamp(min=1e-3)
        known = (mass * SATURATION).clamp(max=1.0)
        keep = torch.exp(-elapsed / self.memory_s)
        mean = torch.cat([recalled[:, :-2], aged], 1) / share * known
        seen = torch.cat([now, torch.ones_like(mass), torch.zeros_like(mass)], 1)
        old = torch.cat([recalled[:, :-1], aged], 1)
        kept = old * keep + seen * (1 - keep)
        return torch.cat([now, mean, known], 1), kept.flatten(2).transpose(1, 2)

    def fuse(self, joined: Tensor) -> Tensor:
        """Map [B, 2 C + 2, rows, columns] to [B, C, rows, columns]."""
        bev: Tensor = self.spatial(self.temporal(joined))
        return bev


def motion_of(can_bus: Tensor, elapsed_s: Tensor) -> EgoMotion:
    """Read how the ego moved from a CAN bus [B, 18] of the policy contract."""
    turn = can_bus[:, 17] * (math.pi / 180)
    before = can_bus[:, 16] - turn
    cos, sin = before.cos(), before.sin()
    dx, dy = can_bus[:, 0], can_bus[:, 1]
    return EgoMotion(
        torch.stack([cos * dx + sin * dy, cos * dy - sin * dx], -1), turn, elapsed_s
    )
