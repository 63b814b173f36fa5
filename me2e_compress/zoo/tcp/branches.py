"""Layers of both branches."""

import itertools

import torch
from torch import Tensor, nn
from torch.nn import functional

from me2e_compress.zoo.resnet import BLOCKS, BasicBlock, ResNet
from me2e_compress.zoo.tcp.config import TcpConfig


class ImageTrunk(ResNet):
    """ResNet-34 with its classifier: maps the strip to a vector and a feature map."""

    def __init__(self, config: TcpConfig) -> None:
        super().__init__(BasicBlock, BLOCKS, config.stem)
        self.fc = nn.Linear(self.channels[-1], config.classes)

    def forward(self, img: Tensor) -> tuple[Tensor, Tensor]:
        """Map [1, 3, 256, 900] to [1, 1000] and [1, 512, 8, 29]."""
        features = self.stages(img)[-1]
        return self.fc(features.mean((2, 3))), features


class RecurrentCell(nn.Module):
    """An ``nn.GRUCell`` (Cho et al. 2014) that the exporter supports."""

    def __init__(self, size: int, hidden: int) -> None:
        super().__init__()
        self.weight_ih = nn.Parameter(torch.empty(3 * hidden, size))
        self.weight_hh = nn.Parameter(torch.empty(3 * hidden, hidden))
        self.bias_ih = nn.Parameter(torch.empty(3 * hidden))
        self.bias_hh = nn.Parameter(torch.empty(3 * hidden))

    def forward(self, x: Tensor, hidden: Tensor) -> Tensor:
        """Map [1, size] and [1, hidden] to [1, hidden]."""
        seen = functional.linear(x, self.weight_ih, self.bias_ih).chunk(3, 1)
        known = functional.linear(hidden, self.weight_hh, self.bias_hh).chunk(3, 1)
        reset = torch.sigmoid(seen[0] + known[0])
        keep = torch.sigmoid(seen[1] + known[1])
        new = torch.tanh(seen[2] + reset * known[2])
        return new + keep * (hidden - new)


class MapReader(nn.Sequential):
    """Maps a vector to weights over the cells of the image map, which sum to 1."""

    def __init__(self, size: int, config: TcpConfig) -> None:
        rows, columns = config.map_hw
        super().__init__(
            nn.Linear(size, config.hidden),
            nn.ReLU(),
            nn.Linear(config.hidden, rows * columns),
            nn.Softmax(1),
        )
        self.hw = config.map_hw

    def read(self, features: Tensor, by: Tensor) -> Tensor:
        """Return [1, 512], the weighted sum of the map [1, 512, 8, 29]."""
        weights = self(by).view(1, 1, *self.hw)
        read: Tensor = (features * weights).sum((2, 3))
        return read


def layers(*sizes: int) -> nn.Sequential:
    """Build linear layers of the given sizes, each with a ReLU."""
    built = nn.Sequential()
    for size, out in itertools.pairwise(sizes):
        built.extend([nn.Linear(size, out), nn.ReLU()])
    return built


def scorer(size: int, hidden: int) -> nn.Sequential:
    """Build two layers and a scalar output, with the dropout of training."""
    return nn.Sequential(
        nn.Linear(size, hidden),
        nn.ReLU(),
        nn.Linear(hidden, hidden),
        nn.Dropout(0.5),
        nn.ReLU(),
        nn.Linear(hidden, 1),
    )
