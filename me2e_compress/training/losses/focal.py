"""The penalty-reduced focal loss of CenterNet (Zhou et al., 2019)."""

from torch import Tensor
from torch.nn import functional

SHARPNESS = 2.0
"""Exponent of (1 - p): alpha of the paper."""


def focal(logits: Tensor, peaks: Tensor, halo: Tensor) -> Tensor:
    """Mean loss a peak.

    Args:
        logits: [...].
        peaks: [...] 1 where somebody is, else 0.
        halo: [...] in [0, 1]: how far a cell beside a peak is forgiven.
    """
    probability = logits.sigmoid()
    hit = peaks * (1 - probability) ** SHARPNESS * functional.logsigmoid(logits)
    miss = (1 - peaks) * (1 - halo) * probability**SHARPNESS
    miss = miss * functional.logsigmoid(-logits)
    return -(hit + miss).sum() / peaks.sum().clamp(min=1)
