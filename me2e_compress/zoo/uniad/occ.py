"""The occupancy head of UniAD: which cells the agents will fill."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from me2e_compress.zoo.bev.attention import PackedAttention
from me2e_compress.zoo.bev.sizes import EMBED
from me2e_compress.zoo.uniad.layers import projection

FUTURES = 5
"""Now and four steps of 0.5 s."""

WIDE_FEED_FORWARD = 2048
PROJECTIONS = 4
REACH = 0.5
"""Cells of this probability and more belong to an instance."""


def convolution(channels: int, out: int, kernel: int, stride: int = 1) -> nn.Conv2d:
    """Build a convolution that a normalisation follows."""
    return nn.Conv2d(channels, out, kernel, stride, kernel // 2, bias=False)


class NormalisedConv(nn.Module):
    """Convolution, normalisation, ReLU under the names of the published weights."""

    def __init__(self) -> None:
        super().__init__()
        self.conv = convolution(EMBED, EMBED, 3)
        self.bn = nn.BatchNorm2d(EMBED)

    def forward(self, x: Tensor) -> Tensor:
        """Map [N, 256, h, w] to the same shape."""
        return torch.relu(self.bn(self.conv(x)))


class LightProjection(nn.Module):
    """Three `NormalisedConv`s and a plain convolution."""

    def __init__(self) -> None:
        super().__init__()
        convs: list[nn.Module] = [NormalisedConv() for _ in range(PROJECTIONS - 1)]
        self.conv_layers = nn.Sequential(*convs, nn.Conv2d(EMBED, EMBED, 1))

    def forward(self, x: Tensor) -> Tensor:
        """Map [N, 256, h, w] to the same shape."""
        out: Tensor = self.conv_layers(x)
        return out


class Downscale(nn.Module):
    """A bottleneck that halves rows and columns."""

    def __init__(self) -> None:
        super().__init__()
        half = EMBED // 2
        self.layers = nn.Sequential()
        for name, layer in (
            ("conv_down_project", convolution(EMBED, half, 1)),
            ("abn_down_project", nn.Sequential(nn.BatchNorm2d(half), nn.ReLU())),
            ("conv", convolution(half, half, 3, 2)),
            ("abn", nn.Sequential(nn.BatchNorm2d(half), nn.ReLU())),
            ("conv_up_project", convolution(half, EMBED, 1)),
            ("abn_up_project", nn.Sequential(nn.BatchNorm2d(EMBED), nn.ReLU())),
        ):
            self.layers.add_module(name, layer)
        self.projection = nn.Sequential()
        self.projection.add_module("upsample_skip_proj", nn.MaxPool2d(2, 2))
        self.projection.add_module("conv_skip_proj", convolution(EMBED, EMBED, 1))
        self.projection.add_module("bn_skip_proj", nn.BatchNorm2d(EMBED))

    def forward(self, x: Tensor) -> Tensor:
        """Map [N, 256, h, w] to [N, 256, ceil(h / 2), ceil(w / 2)]."""
        rows, columns = (int(n) for n in x.shape[2:])
        padded = functional.pad(x, (0, columns % 2, 0, rows % 2))
        out: Tensor = self.layers(x) + self.projection(padded)
        return out


class UpsamplingAdd(nn.Module):
    """Twice the rows and columns, projected, and what stood there before."""

    def __init__(self) -> None:
        super().__init__()
        self.upsample_layer = nn.Sequential(
            nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False),
            convolution(EMBED, EMBED, 1),
            nn.BatchNorm2d(EMBED),
        )

    def forward(self, x: Tensor, before: Tensor) -> Tensor:
        """Map [N, 256, h, w] and [N, 256, 2 h, 2 w] to the latter."""
        out: Tensor = self.upsample_layer(x) + before
        return out


class DecoderBlock(nn.Module):
    """Twice the rows and columns, with the state as it came in added."""

    def __init__(self, *, last: bool) -> None:
        super().__init__()
        half = EMBED // 2
        self.last = last
        self.conv = nn.Sequential(
            nn.Upsample(scale_factor=2, mode="bilinear", align_corners=True),
            convolution(EMBED, half, 3),
            nn.BatchNorm2d(half),
            nn.ReLU(),
            convolution(half, EMBED, 1),
            nn.BatchNorm2d(EMBED),
        )
        self.up = nn.Conv2d(EMBED, EMBED, 1)

    def forward(self, x: Tensor, state: Tensor) -> Tensor:
        """Map [N, 256, h, w] to [N, 256, 2 h, 2 w]."""
        larger: Tensor = self.conv(x)
        size = [int(n) for n in larger.shape[2:]]
        larger = larger + functional.interpolate(self.up(state), size, mode="nearest")
        return larger if self.last else torch.relu(larger)


class DenseDecoder(nn.Module):
    """States to four times their rows and columns."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.ModuleList([DecoderBlock(last=False), DecoderBlock(last=True)])

    def forward(self, states: Tensor) -> Tensor:
        """Map [N, 256, h, w] to [N, 256, 4 h, 4 w]."""
        x = states
        for layer in self.layers:
            x = layer(x, states)
        return x


class StateAttention(nn.Module):
    """`PackedAttention` with the residual, under the names of mmcv."""

    def __init__(self) -> None:
        super().__init__()
        self.attn = PackedAttention()

    def forward(self, x: Tensor, key: Tensor, ignore: Tensor | None = None) -> Tensor:
        """Map [1, cells, 256] and keys [1, K, 256] to [1, cells, 256].

        ``ignore`` is [1, cells, K] bool.
        """
        out: Tensor = x + self.attn(x, key, key, ignore)
        return out


class StateLayer(nn.Module):
    """Cells attend to cells, then to the instances that are theirs."""

    def __init__(self) -> None:
        super().__init__()
        self.attentions = nn.ModuleList([StateAttention(), StateAttention()])
        self.ffns = nn.ModuleList([WideFeedForward()])
        self.norms = nn.ModuleList(nn.LayerNorm(EMBED) for _ in range(3))

    def forward(self, x: Tensor, instances: Tensor, ignore: Tensor) -> Tensor:
        """Map [1, cells, 256] and [1, A, 256] to [1, cells, 256]."""
        x = self.norms[0](self.attentions[0](x, x))
        x = self.norms[1](self.attentions[1](x, instances, ignore))
        out: Tensor = self.norms[2](self.ffns[0](x))
        return out


class WideFeedForward(nn.Module):
    """Linear, ReLU, linear, residual, four times as wide as elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Sequential(nn.Linear(EMBED, WIDE_FEED_FORWARD), nn.ReLU()),
            nn.Linear(WIDE_FEED_FORWARD, EMBED),
        )

    def forward(self, x: Tensor) -> Tensor:
        """Map [..., 256] to [..., 256]."""
        out: Tensor = x + self.layers(x)
        return out


class StateDecoder(nn.Module):
    """One `StateLayer` a step, and a normalisation that only the whole would apply."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.ModuleList(StateLayer() for _ in range(FUTURES))
        self.post_norm = nn.LayerNorm(EMBED)


class Layered(nn.Module):
    """Linear layers with ReLUs between them, under their published names."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(EMBED, EMBED) for _ in range(count))

    def forward(self, x: Tensor) -> Tensor:
        """Map [..., 256] to [..., 256]."""
        for index, layer in enumerate(self.layers):
            x = layer(torch.relu(x) if index else x)
        return x


class OccHead(nn.Module):
    """The view and the agents to logits of every agent in every cell and step."""

    def __init__(self) -> None:
        super().__init__()
        self.bev_light_proj = LightProjection()
        self.base_downscale = nn.Sequential(Downscale(), Downscale())
        self.transformer_decoder = StateDecoder()
        self.temporal_mlps = nn.ModuleList(Layered(2) for _ in range(FUTURES))
        self.downscale_convs = nn.ModuleList(Downscale() for _ in range(FUTURES))
        self.upsample_adds = nn.ModuleList(UpsamplingAdd() for _ in range(FUTURES))
        self.dense_decoder = DenseDecoder()
        self.mode_fuser = projection(EMBED, EMBED)
        self.multi_query_fuser = nn.Sequential(
            *projection(3 * EMBED, 2 * EMBED), nn.Linear(2 * EMBED, EMBED)
        )
        self.query_to_occ_feat = Layered(3)
        self.temporal_mlp_for_mask = Layered(3)

    def forward(
        self, bev: Tensor, modes: Tensor, track: Tensor, track_pos: Tensor
    ) -> Tensor:
        """Predict.

        Args:
            bev: [1, 256, rows, columns], cut to the area that is predicted; both are
                multiples of 8.
            modes: [1, A, 6, 256], queries of the last motion layer, without the ego's.
            track: [1, A, 256].
            track_pos: [1, A, 256].

        Returns:
            [1, A, 5, rows, columns] logits.
        """
        state = self.base_downscale(self.bev_light_proj(bev))
        instances = self.mode_fuser(modes).amax(2)
        instances = self.multi_query_fuser(torch.cat([instances, track, track_pos], -1))
        states, embeddings = [], []
        for step in range(FUTURES):
            asked = self.temporal_mlps[step](instances)
            state, embedding = self._step(step, state, asked)
            states.append(state)
            embeddings.append(embedding)
        dense = self.dense_decoder(torch.cat(states))
        masks = self.query_to_occ_feat(torch.cat(embeddings))
        logits = torch.matmul(masks, dense.flatten(2))
        rows, columns = (int(n) for n in dense.shape[2:])
        return logits.unflatten(2, (rows, columns)).transpose(0, 1).unsqueeze(0)

    def _step(self, step: int, state: Tensor, asked: Tensor) -> tuple[Tensor, Tensor]:
        """Return a step's state [1, 256, h, w] and mask queries [1, A, 256]."""
        small = self.downscale_convs[step](state)
        hw = [int(n) for n in small.shape[2:]]
        embedding = self.temporal_mlp_for_mask(asked)
        cells = small.flatten(2).transpose(1, 2)
        mine = torch.matmul(cells, embedding.transpose(1, 2)).sigmoid() >= REACH
        ignore = torch.logical_not(mine) & mine.any(2, keepdim=True)
        cells = self.transformer_decoder.layers[step](cells, asked, ignore)
        image = cells.transpose(1, 2).unflatten(2, hw)
        return self.upsample_adds[step](image, state), embedding
