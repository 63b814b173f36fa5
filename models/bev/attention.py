"""Attention blocks."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.bev.fused_attention import fused_deformable_attention
from models.bev.sampling import sample
from models.bev.sizes import ATTENTION_HEADS, EMBED, Sampling

Levels = tuple[tuple[int, int], ...]
"""Height and width of each feature level."""

MASKED_LOGIT = -1.0e4
"""Softmax makes it 0; unlike minus infinity it fits float16 and any observer."""

HEAD_SCALE = (EMBED // ATTENTION_HEADS) ** -0.5


class PackedAttention(nn.Module):
    """Scaled dot-product attention with the q, k and v projections in one tensor."""

    def __init__(self) -> None:
        super().__init__()
        self.in_proj_weight = nn.Parameter(torch.empty(3 * EMBED, EMBED))
        self.in_proj_bias = nn.Parameter(torch.empty(3 * EMBED))
        self.out_proj = nn.Linear(EMBED, EMBED)

    def forward(
        self, query: Tensor, key: Tensor, value: Tensor, ignore: Tensor | None = None
    ) -> Tensor:
        """Map queries [B, Q, 256] and keys [B, K, 256] to [B, Q, 256].

        ``value`` is [B, K, 256], or [1, K, 256] for the whole batch; ``ignore`` is [B,
        K] or [B, Q, K] bool, true where a key must not be seen.
        """
        # Project and split into heads
        weights = self.in_proj_weight.chunk(3)
        biases = self.in_proj_bias.chunk(3)
        q, k, v = (
            _split_heads(functional.linear(x, weight, bias))
            for x, weight, bias in zip(
                (query, key, value), weights, biases, strict=True
            )
        )
        # Mask ignored keys
        logits = torch.matmul(q * HEAD_SCALE, k.transpose(-2, -1))
        if ignore is not None:
            one_for_all = ignore.dim() == 2
            ignore = ignore[:, None, None] if one_for_all else ignore[:, None]
            logits = logits.masked_fill(ignore, MASKED_LOGIT)
        mixed = torch.matmul(logits.softmax(-1), v).transpose(1, 2).flatten(2)
        out: Tensor = self.out_proj(mixed)
        return out


def _split_heads(x: Tensor) -> Tensor:
    return x.view(x.shape[0], x.shape[1], ATTENTION_HEADS, -1).transpose(1, 2)


class MultiheadAttention(nn.Module):
    """Attention with a residual; positions may be added to query and key."""

    def __init__(self) -> None:
        super().__init__()
        self.attn = PackedAttention()

    def forward(
        self,
        query: Tensor,
        key: Tensor,
        query_pos: Tensor | None = None,
        key_pos: Tensor | None = None,
        ignore: Tensor | None = None,
    ) -> Tensor:
        """Map [B, Q, 256] and keys, which are also the values, to [B, Q, 256].

        ``ignore`` is as in `PackedAttention`.
        """
        asked = query if query_pos is None else query + query_pos
        offered = key if key_pos is None else key + key_pos
        attended: Tensor = self.attn(asked, offered, key, ignore)
        return query + attended


def deformable_attention(
    value: Tensor,
    hws: Levels,
    locations: Tensor,
    weights: Tensor,
    sampling: Sampling,
) -> Tensor:
    """Return the weighted sum of samples of feature levels, [B, Q, heads * 32].

    Zhu et al. 2021, equation 2. ``value`` is [B, cells of all levels, heads, 32],
    ``hws`` the height and width of each level, ``locations`` [B, Q, heads, L, P, 2], x
    then y with 0 and 1 at the outer edges, and ``weights`` [B, Q, heads, L, P], summing
    to 1 over the last two axes. ``sampling="fused"`` exports one node for all of it;
    see `sample`.
    """
    if sampling == "fused":
        return fused_deformable_attention(value, hws, locations, weights).flatten(2)
    # One image per level and head
    batch, _, heads, channels = value.shape
    queries, points = locations.shape[1], len(hws) * locations.shape[4]
    cells = value.flatten(2).transpose(1, 2)
    maps = [cells] if len(hws) == 1 else cells.split([h * w for h, w in hws], 2)
    images = [
        each.reshape(batch * heads, channels, *hw)
        for each, hw in zip(maps, hws, strict=True)
    ]
    # grid_sample takes -1..1
    grids = 2 * locations - 1
    parts = [
        sample(image, grids[:, :, :, level].transpose(1, 2).flatten(0, 1), sampling)
        for level, image in enumerate(images)
    ]
    sampled = parts[0] if len(parts) == 1 else torch.cat(parts, -1)
    parts.clear()  # of UniAD's cameras they are 2 GB
    # Weight the samples and sum
    weights = weights.transpose(1, 2).reshape(batch * heads, 1, queries, points)
    out = (sampled * weights).sum(-1).view(batch, heads * channels, queries)
    return out.transpose(1, 2)


class DecoderAttention(nn.Module):
    """Queries attend to the BEV around their reference points.

    ``held`` is the number of levels to hold weights for, though there is only one. For
    more than one, samples follow mmcv's kernel: it reads offsets and weights as if they
    were for one level, so that the first part of the queries supplies those of all.
    Published models were trained so (UniAD's map head holds four). ``boxes`` says that
    the reference points are boxes.
    """

    points = 4

    def __init__(
        self,
        hw: tuple[int, int],
        sampling: Sampling,
        *,
        held: int = 1,
        boxes: bool = False,
    ) -> None:
        super().__init__()
        self.hw = hw
        self.boxes = boxes
        self.sampling: Sampling = sampling
        self.held = held
        samples = ATTENTION_HEADS * held * self.points
        self.sampling_offsets = nn.Linear(EMBED, samples * 2)
        self.attention_weights = nn.Linear(EMBED, samples)
        self.value_proj = nn.Linear(EMBED, EMBED)
        self.output_proj = nn.Linear(EMBED, EMBED)
        self.register_buffer("size_xy", torch.tensor(hw[::-1]).float(), False)

    size_xy: Tensor

    def forward(self, query: Tensor, pos: Tensor, bev: Tensor, at: Tensor) -> Tensor:
        """Map queries [1, Q, 256] to [1, Q, 256], with the residual.

        ``pos`` [1, Q, 256] is added to the query; ``bev`` is [1, cells, 256]; ``at``
        holds reference points [1, Q, 2] or boxes [1, Q, 4] (cx, cy, w, h), 0..1.
        """
        # Only the first queries supply offsets if several levels are held
        asked = query + pos
        batch, queries, _ = asked.shape
        value = self.value_proj(bev)
        value = value.view(batch, value.shape[1], ATTENTION_HEADS, -1)
        speak, samples = queries, self.held * self.points
        # Reread them as mmcv's kernel does
        if self.held > 1:
            speak = (queries + self.held - 1) // self.held
            asked, at = asked[:, :speak], at[:, :speak]
        # Offsets and weights per head, level and point
        offsets = self.sampling_offsets(asked)
        offsets = offsets.view(batch, speak, ATTENTION_HEADS, self.held, self.points, 2)
        weights = self.attention_weights(asked)
        weights = weights.view(batch, speak, ATTENTION_HEADS, samples).softmax(-1)
        weights = weights.view(batch, speak, ATTENTION_HEADS, self.held, self.points)
        locations = self._locations(at[:, :, None, None, None, :], offsets)
        if self.held > 1:
            locations, weights = (
                each.reshape(1, -1, ATTENTION_HEADS, 1, *each.shape[4:])[:, :queries]
                for each in (locations, weights)
            )
        out = deformable_attention(value, (self.hw,), locations, weights, self.sampling)
        read: Tensor = self.output_proj(out)
        return query + read

    def _locations(self, at: Tensor, offsets: Tensor) -> Tensor:
        """Add offsets, in cells around points or relative to half the size of boxes."""
        if not self.boxes:
            return at + offsets / self.size_xy
        return at[..., :2] + offsets * at[..., 2:] * (0.5 / self.points)
