"""Detection: peaks of a detection map become queries, queries become boxes."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.driver.network.bev_grid import cell_centres
from models.driver.network.blocks import DecoderLayer, conv_block, mlp
from models.driver.network.config import AGENT_CLASSES, HighwayConfig

SPEED_SCALE_MPS = 10.0
"""Velocities are predicted in these units, about 1 in size."""
SIZE_SCALE_M = 2.0
"""Boxes are e^x times this long and wide."""
RARE = -3.0
"""First logit of the detection map: nearly every cell is empty, and a map that begins
undecided spends the first steps on that (Lin et al., RetinaNet, 2017, section 4.1)."""


@dataclass
class Tracks:
    """Outputs of the track module.

    Attributes:
        query: [B, A, C].
        boxes: [B, A, 8] x, y, length, width, cos, sin, vx, vy: metres and m/s, in the
            axes of the ego.
        score: [B, A] probability that an agent is there.
        classes: [B, A, 4] logits.
        heat: [B, N] logits of the detection map.
        cells: [B, A] the cell that each query came from.
        logits: [B, A] of the score.
    """

    query: Tensor
    boxes: Tensor
    score: Tensor
    classes: Tensor
    heat: Tensor
    cells: Tensor
    logits: Tensor


class Track(nn.Module):
    """Detection map, its strongest peaks, one decoder layer."""

    centres: Tensor

    def __init__(self, config: HighwayConfig) -> None:
        super().__init__()
        channels, self.area = config.channels, config.area
        self.agents = config.agents
        body, last = conv_block(channels, channels), nn.Conv2d(channels, 1, 1)
        nn.init.constant_(last.get_parameter("bias"), RARE)
        self.heat = nn.Sequential(body, last)
        self.place = mlp(2, channels, channels)
        self.layer = DecoderLayer(channels, config.heads)
        self.box = mlp(channels, channels, 8)
        self.kind = nn.Linear(channels, AGENT_CLASSES)
        self.score = mlp(channels, channels, 1)
        self.register_buffer("centres", cell_centres(self.area), False)

    def forward(
        self, bev: Tensor, tokens: Tensor, hints: Tensor | None = None
    ) -> Tracks:
        """Detect.

        Args:
            bev: [B, C, rows, columns].
            tokens: [B, N, C], the same with the place of each cell.
            hints: [B, N], added to the peaks: in training, where agents are.
        """
        heat = self.heat(bev)
        strength = heat.float().sigmoid()
        peak = functional.max_pool2d(strength, 3, 1, 1) == strength
        peaks = (strength * peak.float()).flatten(1)
        if hints is not None:
            peaks = peaks + hints
        _, cells = peaks.topk(self.agents, dim=1)
        centres = self.centres.expand(bev.shape[0], -1, -1)
        where = _pick(centres, cells)
        query = _pick(bev.flatten(2).transpose(1, 2), cells) + self.place(where / 24)
        query = self.layer(query, tokens, tokens)
        raw = self.box(query).float()
        logits = self.score(query).squeeze(-1).float()
        boxes = torch.cat(
            [
                where + raw[..., 0:2],
                raw[..., 2:4].clamp(-3, 3).exp() * SIZE_SCALE_M,
                functional.normalize(raw[..., 4:6], dim=-1, eps=1e-3),
                raw[..., 6:8] * SPEED_SCALE_MPS,
            ],
            -1,
        )
        score = logits.sigmoid()
        return Tracks(
            query, boxes, score, self.kind(query), heat.flatten(1), cells, logits
        )


def _pick(rows: Tensor, index: Tensor) -> Tensor:
    """Gather [B, N, C] at [B, A] to [B, A, C]."""
    return rows.gather(1, index[..., None].expand(-1, -1, rows.shape[-1]))
