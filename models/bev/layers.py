"""Layers that several heads and encoders use."""

import itertools

from torch import Tensor, nn

from models.bev.attention import PackedAttention
from models.bev.sizes import EMBED, FEED_FORWARD


def mlp(*sizes: int) -> nn.Sequential:
    """Build linear layers of the given sizes with ReLUs between them."""
    built = nn.Sequential()
    for index, (size, out) in enumerate(itertools.pairwise(sizes)):
        if index:
            built.append(nn.ReLU())
        built.append(nn.Linear(size, out))
    return built


def projection(size: int, out: int) -> nn.Sequential:
    """Build a linear layer, its normalisation and a ReLU."""
    return nn.Sequential(nn.Linear(size, out), nn.LayerNorm(out), nn.ReLU())


def classifier(classes: int, width: int = EMBED) -> nn.Sequential:
    """Build two normalised layers and the logits."""
    hidden = (*projection(width, width), *projection(width, width))
    return nn.Sequential(*hidden, nn.Linear(width, classes))


class FeedForward(nn.Module):
    """Linear, ReLU, linear, residual."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Sequential(nn.Linear(EMBED, hidden), nn.ReLU()),
            nn.Linear(hidden, EMBED),
        )

    def forward(self, x: Tensor) -> Tensor:
        """Map [..., 256] to [..., 256]."""
        out: Tensor = x + self.layers(x)
        return out


class AttentionLayer(nn.Module):
    """Attentions with residuals, then a feed-forward, each normalised."""

    def __init__(self, *attentions: nn.Module, hidden: int = FEED_FORWARD) -> None:
        super().__init__()
        self.attentions = nn.ModuleList(attentions)
        self.ffns = nn.ModuleList([FeedForward(hidden)])
        self.norms = nn.ModuleList(
            nn.LayerNorm(EMBED) for _ in range(len(attentions) + 1)
        )

    def forward(self, x: Tensor, *reads: tuple[Tensor | None, ...]) -> Tensor:
        """Map [B, Q, 256] to [B, Q, 256].

        ``reads`` are the arguments of each attention after the queries.
        """
        for attention, norm, read in zip(
            self.attentions, self.norms[:-1], reads, strict=True
        ):
            x = norm(attention(x, *read))
        out: Tensor = self.norms[-1](self.ffns[0](x))
        return out


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
