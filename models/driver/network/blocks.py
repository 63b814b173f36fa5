"""Building blocks: convolutions, attention, look-ups in feature maps."""

import math
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional


def conv_block(inputs: int, outputs: int, size: int = 3, stride: int = 1) -> nn.Module:
    """Build convolution, batch normalisation, ReLU."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class Residual(nn.Module):
    """Two 3 x 3 convolutions beside a shortcut (He et al., 2016, basic block)."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.first = conv_block(inputs, outputs, 3, stride)
        self.second = nn.Sequential(
            nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False), nn.BatchNorm2d(outputs)
        )
        same = stride == 1 and inputs == outputs
        self.shortcut = nn.Identity() if same else nn.Conv2d(inputs, outputs, 1, stride)

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, inputs, H, W] to [B, outputs, H / stride, W / stride]."""
        return functional.relu(self.second(self.first(x)) + self.shortcut(x))


class MultiHeadAttention(nn.Module):
    """Scaled dot-product attention (Vaswani et al., 2017)."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads, self.depth = heads, channels // heads
        self.query = nn.Linear(channels, channels)
        self.key = nn.Linear(channels, channels)
        self.value = nn.Linear(channels, channels)
        self.output = nn.Linear(channels, channels)

    def forward(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Map [B, Q, C], [B, K, C], [B, K, C] to [B, Q, C]."""
        q, k, v = (
            project(x).unflatten(-1, (self.heads, self.depth)).transpose(1, 2)
            for project, x in (
                (self.query, query),
                (self.key, key),
                (self.value, value),
            )
        )
        scores = torch.matmul(q / math.sqrt(self.depth), k.transpose(-1, -2))
        mixed = torch.matmul(scores.softmax(-1), v)
        answer: Tensor = self.output(mixed.transpose(1, 2).flatten(2))
        return answer


class DecoderLayer(nn.Module):
    """Self-attention, cross-attention, feed-forward, each after a LayerNorm."""

    def __init__(self, channels: int, heads: int, *, selfish: bool = True) -> None:
        super().__init__()
        self.self_attn = MultiHeadAttention(channels, heads) if selfish else None
        self.cross_attn = MultiHeadAttention(channels, heads)
        self.norms = nn.ModuleList([nn.LayerNorm(channels) for _ in range(3)])
        self.ffn = nn.Sequential(
            nn.Linear(channels, 2 * channels),
            nn.ReLU(inplace=True),
            nn.Linear(2 * channels, channels),
        )

    def forward(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Attend from [B, Q, C] to [B, K, C]."""
        if self.self_attn is not None:
            own = self.norms[0](query)
            query = query + self.self_attn(own, own, own)
        query = query + self.cross_attn(self.norms[1](query), key, value)
        answer: Tensor = query + self.ffn(self.norms[2](query))
        return answer


def mlp(*widths: int) -> nn.Sequential:
    """Build linear layers with ReLU between them."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers[:-1])


def sample(features: Tensor, grid: Tensor) -> Tensor:
    """Sample bilinearly, zero outside: [B, C, H, W] at [B, I, J, 2] in [-1, 1]."""
    return functional.grid_sample(
        features.float(), grid.float(), padding_mode="zeros", align_corners=False
    )
