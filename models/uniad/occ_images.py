"""Convolutions of the occupancy head, and the area that it samples from the view."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.bev.sampling import sample
from models.bev.sizes import EMBED, BevGrid, Sampling
from models.uniad.config import OCC_REACH_M

PROJECTIONS = 4

Size = tuple[int, int]
"""Rows and columns."""


def halved(hw: Size) -> Size:
    """Return half of each, rounded up."""
    return -(-hw[0] // 2), -(-hw[1] // 2)


class AreaSampler(nn.Module):
    """The square of 100 m around the vehicle, in as many cells as the view has.

    As in the original, the centres of the outermost cells lie on the edge of its range.
    """

    def __init__(self, grid: BevGrid, hw: Size, sampling: Sampling) -> None:
        super().__init__()
        self.hw = hw
        self.sampling: Sampling = sampling
        axes = []
        for count, reach in zip(hw, (grid.pc_range[4], grid.pc_range[3]), strict=True):
            side = (torch.arange(count) + 0.5) / count * 2 - 1
            corners = side * (OCC_REACH_M / reach)  # -1 and 1: centres of the outermost
            axes.append((corners * (count - 1)) / count)  # -1 and 1: their outer edges
        rows, columns = torch.meshgrid(*axes, indexing="ij")
        self.register_buffer("places", torch.stack([columns, rows], -1)[None], False)

    places: Tensor

    def forward(self, bev: Tensor) -> Tensor:
        """Map [1, cells, 256] to [1, 256, rows, columns]."""
        image = bev.transpose(1, 2).unflatten(2, self.hw)
        return sample(image, self.places, self.sampling)


def convolution(channels: int, out: int, kernel: int, stride: int = 1) -> nn.Conv2d:
    """Build a convolution that is followed by a normalisation."""
    return nn.Conv2d(channels, out, kernel, stride, kernel // 2, bias=False)


class NormalisedConv(nn.Module):
    """Convolution, normalisation and ReLU, with the published names."""

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
    """A bottleneck that halves rows and columns, rounded up."""

    def __init__(self, hw: Size) -> None:
        super().__init__()
        self.pad = (0, hw[1] % 2, 0, hw[0] % 2)
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
        padded = functional.pad(x, self.pad) if any(self.pad) else x
        out: Tensor = self.layers(x) + self.projection(padded)
        return out


class UpsamplingAdd(nn.Module):
    """Doubles rows and columns, projects, and adds the earlier state."""

    def __init__(self, hw: Size) -> None:
        super().__init__()
        self.upsample_layer = nn.Sequential(
            nn.Upsample(size=hw, mode="bilinear", align_corners=False),
            convolution(EMBED, EMBED, 1),
            nn.BatchNorm2d(EMBED),
        )

    def forward(self, x: Tensor, before: Tensor) -> Tensor:
        """Map [N, 256, h / 2, w / 2] and [N, 256, h, w] to the latter."""
        out: Tensor = self.upsample_layer(x) + before
        return out


class DecoderBlock(nn.Module):
    """Doubles rows and columns and adds the original state."""

    def __init__(self, hw: Size, *, last: bool) -> None:
        super().__init__()
        half = EMBED // 2
        self.size = (2 * hw[0], 2 * hw[1])
        self.last = last
        self.conv = nn.Sequential(
            nn.Upsample(size=self.size, mode="bilinear", align_corners=True),
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
        kept = functional.interpolate(self.up(state), self.size, mode="nearest")
        larger = larger + kept
        return larger if self.last else torch.relu(larger)


class DenseDecoder(nn.Module):
    """Quadruples the rows and columns of states."""

    def __init__(self, hw: Size) -> None:
        super().__init__()
        twice = (2 * hw[0], 2 * hw[1])
        self.layers = nn.ModuleList(
            [DecoderBlock(hw, last=False), DecoderBlock(twice, last=True)]
        )

    def forward(self, states: Tensor) -> Tensor:
        """Map [N, 256, h, w] to [N, 256, 4 h, 4 w]."""
        x = states
        for layer in self.layers:
            x = layer(x, states)
        return x
