"""Layers that several heads of UniAD use."""

from torch import Tensor, nn

from me2e_compress.zoo.bev.attention import PackedAttention
from me2e_compress.zoo.bev.sizes import EMBED, FEED_FORWARD


class TransformerLayer(nn.Module):
    """Self-attention, cross-attention and feed-forward, as in torch's decoder."""

    def __init__(self, *, cross: bool = True) -> None:
        super().__init__()
        self.self_attn = PackedAttention()
        self.norm1 = nn.LayerNorm(EMBED)
        if cross:
            self.multihead_attn = PackedAttention()
            self.norm3 = nn.LayerNorm(EMBED)
        self.norm2 = nn.LayerNorm(EMBED)
        self.linear1 = nn.Linear(EMBED, FEED_FORWARD)
        self.linear2 = nn.Linear(FEED_FORWARD, EMBED)
        self.cross = cross

    def forward(
        self, x: Tensor, memory: Tensor | None = None, ignore: Tensor | None = None
    ) -> Tensor:
        """Map [B, Q, 256], reading keys and values [B or 1, K, 256], to [B, Q, 256].

        ``ignore`` is [B, K] bool, true where a key must not be seen.
        """
        x = self.norm1(x + self.self_attn(x, x, x))
        if self.cross:
            x = self.norm2(x + self.multihead_attn(x, memory, memory, ignore))
        last = self.norm3 if self.cross else self.norm2
        out: Tensor = last(x + self.linear2(self.linear1(x).relu()))
        return out


def mlp(*sizes: int) -> nn.Sequential:
    """Build linear layers of the given sizes with ReLUs between them."""
    built = nn.Sequential()
    for index in range(len(sizes) - 1):
        if index:
            built.append(nn.ReLU())
        built.append(nn.Linear(sizes[index], sizes[index + 1]))
    return built


def projection(size: int, out: int) -> nn.Sequential:
    """Build a linear layer, its normalisation and a ReLU."""
    return nn.Sequential(nn.Linear(size, out), nn.LayerNorm(out), nn.ReLU())
