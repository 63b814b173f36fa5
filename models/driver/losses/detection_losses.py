"""Losses of detection: boxes, their futures, and lamps and signs in the images.

Detection maps are compared with the penalty-reduced focal loss of CenterNet (Zhou et
al., 2019).
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.driver.label_tensors import Labels
from models.driver.network.config import CAMERAS, BevArea
from models.driver.network.motion import Futures
from models.driver.network.track import Tracks

SHARPNESS = 2.0
"""Exponent of (1 - p) in the focal loss: alpha of CenterNet."""


def focal_loss(logits: Tensor, peaks: Tensor, halo: Tensor) -> Tensor:
    """Return the penalty-reduced focal loss, mean over the peaks.

    Args:
        logits: [...].
        peaks: [...] 1 at an object, else 0.
        halo: [...] in [0, 1]: how far a cell beside a peak is forgiven.
    """
    probability = logits.sigmoid()
    hit = peaks * (1 - probability) ** SHARPNESS * functional.logsigmoid(logits)
    miss = (1 - peaks) * (1 - halo) * probability**SHARPNESS
    miss = miss * functional.logsigmoid(-logits)
    return -(hit + miss).sum() / peaks.sum().clamp(min=1)


AGENT_HALO = 0.7
"""How far the eight cells around an agent are forgiven."""
SPEED_STEP_MPS = 2.0
"""An error of the velocity counts in steps of this, beside metres of the place: over
the 3 s of a plan, 2 m/s are more than a car's length."""
NEAR_M = 4.0
"""A query this far from an agent is not matched with it."""


def match(tracks: Tracks, wanted: Labels) -> tuple[Tensor, Tensor]:
    """Match every agent with its nearest query.

    Returns:
        (int64 [B, Q] agent of each query, bool [B, Q] whether it has one).
    """
    place = tracks.boxes[..., :2].detach()
    away = (place[:, :, None] - wanted.agents[:, None, :, 1:3]).norm(dim=-1)
    away = away.masked_fill(~wanted.there[:, None], torch.inf)
    best, query = away.min(1)
    owner = torch.full(place.shape[:2], -1, dtype=torch.int64)
    taken = torch.full(place.shape[:2], torch.inf)
    for agent in range(best.shape[1]):
        mine, where = best[:, agent], query[:, agent]
        held = taken.gather(1, where[:, None])[:, 0]
        wins = (mine < NEAR_M) & (mine < held)
        rows = wins.nonzero()[:, 0]
        owner[rows, where[rows]] = agent
        taken[rows, where[rows]] = mine[rows]
    return owner.clamp(min=0), owner >= 0


def track_losses(
    tracks: Tracks, wanted: Labels, area: BevArea, owner: Tensor, mine: Tensor
) -> dict[str, Tensor]:
    """Return the losses of detection map, presence, boxes and classes."""
    peaks = torch.zeros(tracks.heat.shape)
    peaks = peaks.scatter_add(1, wanted.cells, wanted.there.float()).clamp(max=1)
    grid = peaks.unflatten(1, (1, area.rows, area.columns))
    halo = functional.max_pool2d(grid, 3, 1, 1).flatten(1) * AGENT_HALO
    picked = _pick(wanted.agents, owner)[mine]
    boxes = tracks.boxes[mine]
    aims = torch.stack(
        [
            *(picked[:, 1], picked[:, 2], picked[:, 5].log(), picked[:, 6].log()),
            *(picked[:, 3], picked[:, 4]),
            *(picked[:, 7] / SPEED_STEP_MPS, picked[:, 8] / SPEED_STEP_MPS),
        ],
        -1,
    )
    said = torch.cat(
        [
            boxes[:, :2],
            boxes[:, 2:4].log(),
            boxes[:, 4:6],
            boxes[:, 6:8] / SPEED_STEP_MPS,
        ],
        -1,
    )
    count = mine.sum().clamp(min=1)
    return {
        "heat": focal_loss(tracks.heat.float(), peaks, halo),
        "score": functional.binary_cross_entropy_with_logits(
            tracks.logits, mine.float()
        ),
        "box": functional.smooth_l1_loss(said, aims, reduction="sum") / count,
        "class": functional.cross_entropy(
            tracks.classes[mine].float(), picked[:, 0].long(), reduction="sum"
        )
        / count,
    }


def motion_losses(
    futures: Futures, wanted: Labels, owner: Tensor, mine: Tensor
) -> dict[str, Tensor]:
    """Return the losses of the futures: the best mode learns, and is the likeliest."""
    known = _pick(wanted.travel_known.float(), owner)[mine]
    aims = _pick(wanted.travel.flatten(2), owner)[mine].unflatten(-1, (-1, 2))
    said, logits = futures.travel[mine], futures.logits[mine]
    away = (said - aims[:, None]).norm(dim=-1) * known[:, None]
    best = away.detach().sum(-1).argmin(1)
    rows = torch.arange(len(best))
    error = functional.smooth_l1_loss(said[rows, best], aims, reduction="none")
    seen = known.any(-1).float()
    total = (error.sum(-1) * known).sum() / known.sum().clamp(min=1)
    choice = functional.cross_entropy(logits, best, reduction="none")
    return {
        "travel": total,
        "mode": (choice * seen).sum() / seen.sum().clamp(min=1),
    }


def _pick(rows: Tensor, index: Tensor) -> Tensor:
    return rows.gather(1, index[..., None].expand(-1, -1, rows.shape[-1]))


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
LAMP_HALO = 0.8
"""How far the eight cells around a lamp are forgiven."""


class LampHead(nn.Module):
    """An extra head that teaches the backbone to see lamps and signs; never exported.

    A 1 x 1 convolution: which signal is in a cell of stride 4.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.head = nn.Conv2d(channels, KINDS, 1)
        nn.init.constant_(self.head.get_parameter("bias"), RARE)

    def forward(
        self, features: Tensor, lidar2img: Tensor, wanted: Labels
    ) -> dict[str, Tensor]:
        """Return the focal loss against the projected signals.

        Args:
            features: [B * 6, C, h, w].
            lidar2img: [B, 6, 4, 4].
            wanted: labels.
        """
        logits = self.head(features).float()
        peaks = _peaks(lidar2img, wanted.lamps, logits.shape)
        halo = functional.max_pool2d(peaks, 3, 1, 1) * LAMP_HALO
        return {"lamp": focal_loss(logits, peaks, halo)}


def _peaks(lidar2img: Tensor, lamps: Tensor, shape: torch.Size) -> Tensor:
    """Return [B * 6, 5, h, w], 1 in the cells where a signal is."""
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
