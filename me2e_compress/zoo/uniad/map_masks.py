"""Masks of lanes from the attention of queries to cells (Panoptic SegFormer)."""

import torch
from torch import Tensor, nn

from me2e_compress.zoo.bev.attention import HEAD_SCALE
from me2e_compress.zoo.bev.sizes import ATTENTION_HEADS, EMBED

MASK_FEED_FORWARD = 1024


class MaskAttention(nn.Module):
    """Attention of queries to cells, from which a mask is computed."""

    def __init__(self, *, tail: bool = False) -> None:
        super().__init__()
        self.q = nn.Linear(EMBED, EMBED)
        self.k = nn.Linear(EMBED, EMBED)
        self.tail = tail
        if not tail:
            self.v = nn.Linear(EMBED, EMBED)
            self.proj = nn.Linear(EMBED, EMBED)
        heads = ATTENTION_HEADS
        self.linear_l1 = nn.Sequential(nn.Linear(heads, heads), nn.ReLU())
        self.linear = nn.Sequential(nn.Linear(heads, 1), nn.ReLU())

    def forward(
        self, query: Tensor, key: Tensor, value: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Map [1, Q, 256] and cells [1, K, 256] to [1, Q, 256] and masks [1, Q, K].

        The last layer, the tail, returns its query unchanged.
        """
        q, k = _heads(self.q(query)), _heads(self.k(key))
        logits = torch.matmul(q, k.transpose(-2, -1)) * HEAD_SCALE
        mask = self.linear(self.linear_l1(logits.permute(0, 2, 3, 1))).squeeze(-1)
        if self.tail:
            return query, mask
        mixed = torch.matmul(logits.softmax(-1), _heads(self.v(value)))
        return self.proj(mixed.transpose(1, 2).flatten(2)), mask


def _heads(x: Tensor) -> Tensor:
    heads: Tensor = x.unflatten(2, (ATTENTION_HEADS, -1)).transpose(1, 2)
    return heads


class SelfAttention(nn.Module):
    """Attention of the queries to each other (the published background head)."""

    def __init__(self) -> None:
        super().__init__()
        self.qkv = nn.Linear(EMBED, 3 * EMBED)
        self.proj = nn.Linear(EMBED, EMBED)


class GeluFeedForward(nn.Module):
    """Linear, GELU, linear."""

    def __init__(self) -> None:
        super().__init__()
        self.fc1 = nn.Linear(EMBED, MASK_FEED_FORWARD)
        self.act = nn.GELU()
        self.fc2 = nn.Linear(MASK_FEED_FORWARD, EMBED)

    def forward(self, x: Tensor) -> Tensor:
        """Map [..., 256] to [..., 256]."""
        out: Tensor = self.fc2(self.act(self.fc1(x)))
        return out


class MaskBlock(nn.Module):
    """`MaskAttention` and `GeluFeedForward`, each normalised."""

    def __init__(self, *, self_attention: bool) -> None:
        super().__init__()
        self.head_norm1 = nn.LayerNorm(EMBED, eps=1e-6)
        self.attn = MaskAttention()
        self.head_norm2 = nn.LayerNorm(EMBED, eps=1e-6)
        self.mlp = GeluFeedForward()
        if self_attention:
            self.self_attention = SelfAttention()
            self.norm3 = nn.LayerNorm(EMBED, eps=1e-6)

    def forward(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Map [1, Q, 256] and cells [1, K, 256] to [1, Q, 256]."""
        attended, _ = self.attn(query, key, value)
        query = self.head_norm1(query + attended)
        out: Tensor = self.head_norm2(query + self.mlp(query))
        return out


class MaskHead(nn.Module):
    """Maps queries to masks over the cells."""

    def __init__(self, blocks: int, *, self_attention: bool = False) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(
            MaskBlock(self_attention=self_attention) for _ in range(blocks)
        )
        self.attnen = MaskAttention(tail=True)

    def forward(
        self, query: Tensor, query_pos: Tensor, cells: Tensor, cells_pos: Tensor
    ) -> Tensor:
        """Map [1, Q, 256] and cells [1, K, 256] to masks [1, Q, K]."""
        key = cells + cells_pos
        for block in self.blocks:
            query = block(query + query_pos, key, cells)
        mask: Tensor = self.attnen(query + query_pos, key, cells)[1]
        return mask
