"""An extra head that teaches the backbone to see lamps and signs; never exported."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from me2e_compress.training.labels import Targets
from me2e_compress.training.losses.focal import focal
from me2e_compress.zoo.highway.config import CAMERAS

KINDS = 5
"""Red, yellow, green lamp, stop sign, give-way sign."""
HEIGHT_M = 2.15
"""Middle of a lamp's housing and of a sign."""
NEAREST_M, FARTHEST_M = 1.0, 45.0
"""Nearer a lamp is above the image, farther it is less than two pixels wide."""
STRIDE = 4
"""Of the features, in pixels."""
RARE = -4.0
"""First logit: nearly every cell shows none (Lin et al., RetinaNet, 2017)."""
HALO = 0.8
"""How far the eight cells around a lamp are forgiven."""


class LampHead(nn.Module):
    """A 1 x 1 convolution: which signal is in a cell of stride 4."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.head = nn.Conv2d(channels, KINDS, 1)
        nn.init.constant_(self.head.get_parameter("bias"), RARE)

    def forward(
        self, features: Tensor, lidar2img: Tensor, wanted: Targets
    ) -> dict[str, Tensor]:
        """Focal loss against the projected signals.

        Args:
            features: [B * 6, C, h, w].
            lidar2img: [B, 6, 4, 4].
            wanted: labels.
        """
        logits = self.head(features).float()
        peaks = _peaks(lidar2img, wanted.lamps, logits.shape)
        halo = functional.max_pool2d(peaks, 3, 1, 1) * HALO
        return {"lamp": focal(logits, peaks, halo)}


def _peaks(lidar2img: Tensor, lamps: Tensor, shape: torch.Size) -> Tensor:
    """1 in the cells where a signal is: [B * 6, 5, h, w]."""
    _, _, rows, columns = shape
    kind, state = lamps[..., 0].long(), lamps[..., 1].long()
    channel = torch.where(kind == 0, state, kind + 2)
    height = torch.full_like(lamps[..., 2], HEIGHT_M)
    point = torch.stack(
        [lamps[..., 2], lamps[..., 3], height, torch.ones_like(height)], -1
    )
    seen = torch.einsum("bkij,bsj->bksi", lidar2img, point)
    depth = seen[..., 2]
    column = (seen[..., 0] / depth.clamp(min=0.3) / STRIDE).floor().long()
    row = (seen[..., 1] / depth.clamp(min=0.3) / STRIDE).floor().long()
    ok = (kind >= 0)[:, None] & (depth > NEAREST_M) & (depth < FARTHEST_M)
    # a lamp faces the traffic that must obey: from behind it shows nothing
    ok &= (lamps[..., 4] > 0)[:, None]
    ok &= (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    peaks = torch.zeros(shape)
    b, k, s = ok.nonzero(as_tuple=True)
    peaks[b * CAMERAS + k, channel[b, s], row[b, k, s], column[b, k, s]] = 1.0
    return peaks
