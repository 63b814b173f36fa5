"""The perception part of the head: queries, boxes and map vectors."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from me2e_compress.zoo.bev.decoder import in_metres
from me2e_compress.zoo.bev.encoder import GridPosition
from me2e_compress.zoo.bev.sizes import BOX_CODE, EMBED, Sampling
from me2e_compress.zoo.regions import region
from me2e_compress.zoo.vad.config import LAYERS, Heads, VadConfig
from me2e_compress.zoo.vad.transformer import PerceptionTransformer


class AgentOutputs(NamedTuple):
    """Outputs of detection, with queries and positions of the last layer."""

    scores: Tensor  # [3, 1, 300, classes], logits
    boxes: Tensor  # [3, 1, 300, 10], metres
    queries: Tensor  # [1, 300, 256]
    centres: Tensor  # [1, 300, 2], 0..1


class MapOutputs(NamedTuple):
    """Outputs of the map decoder, with queries and points of the last layer."""

    scores: Tensor  # [3, 1, 100, classes], logits
    boxes: Tensor  # [3, 1, 100, 4], cx cy w h, 0..1
    points: Tensor  # [3, 1, 100, 20, 2], 0..1
    queries: Tensor  # [1, 100, 20, 256]


def classifier(classes: int, width: int = EMBED) -> nn.Sequential:
    """Build two normalised layers and the logits."""
    return nn.Sequential(
        nn.Linear(width, width),
        nn.LayerNorm(width),
        nn.ReLU(),
        nn.Linear(width, width),
        nn.LayerNorm(width),
        nn.ReLU(),
        nn.Linear(width, classes),
    )


def regressor(outputs: int, width: int = EMBED) -> nn.Sequential:
    """Build two layers and the values."""
    return nn.Sequential(
        nn.Linear(width, width),
        nn.ReLU(),
        nn.Linear(width, width),
        nn.ReLU(),
        nn.Linear(width, outputs),
    )


class PerceptionHead(nn.Module):
    """Queries, the perception transformer, and the branches that read it."""

    def __init__(self, heads: Heads, sampling: Sampling, config: VadConfig) -> None:
        super().__init__()
        self.config = config
        self.code_weights = nn.Parameter(torch.empty(BOX_CODE))
        self.map_code_weights = nn.Parameter(torch.empty(4))
        self.positional_encoding = GridPosition(config.grid.hw)
        self.transformer = PerceptionTransformer(sampling, config)
        self.bev_embedding = nn.Embedding(config.grid.cells, EMBED)
        # Queries of agents and map points
        self.query_embedding = nn.Embedding(config.agents, 2 * EMBED)
        self.map_instance_embedding = nn.Embedding(config.vectors, 2 * EMBED)
        self.map_pts_embedding = nn.Embedding(config.vector_points, 2 * EMBED)
        # Branches per layer
        self.cls_branches = _repeat(classifier, heads.det_classes)
        self.reg_branches = _repeat(regressor, BOX_CODE)
        self.map_cls_branches = _repeat(classifier, heads.map_classes)
        self.map_reg_branches = _repeat(regressor, 2)

    def perceive(
        self, features: Tensor, lidar2img: Tensor, can_bus: Tensor, prev_bev: Tensor
    ) -> tuple[Tensor, AgentOutputs, MapOutputs]:
        """Map camera features [cameras, 256, h, w] to BEV, boxes and map vectors."""
        with region("bev_encoder"):
            cells = self.bev_embedding.weight.unsqueeze(0), self.positional_encoding()
        with region("map"):
            points = (
                self.map_instance_embedding.weight.unsqueeze(1)
                + self.map_pts_embedding.weight.unsqueeze(0)
            ).flatten(0, 1)
        # Encode and decode; then the branches
        bev, found, mapped = self.transformer(
            features,
            cells,
            self.query_embedding.weight,
            points,
            (self.reg_branches, self.map_reg_branches),
            lidar2img,
            can_bus,
            prev_bev,
        )
        with region("det"):
            agents = self._agents(*found)
        with region("map"):
            vectors = self._map(*mapped)
        return bev, agents, vectors

    def _agents(
        self, queries: list[Tensor], raw: list[Tensor], at: list[Tensor]
    ) -> AgentOutputs:
        scores = [
            branch(query)
            for branch, query in zip(self.cls_branches, queries, strict=True)
        ]
        boxes = [
            in_metres(r, a, self.config.grid) for r, a in zip(raw, at, strict=True)
        ]
        return AgentOutputs(
            torch.stack(scores), torch.stack(boxes), queries[-1], at[-1][..., :2]
        )

    def _map(
        self, queries: list[Tensor], _raw: list[Tensor], at: list[Tensor]
    ) -> MapOutputs:
        shape = 1, self.config.vectors, self.config.vector_points
        grouped = [q.view(*shape, EMBED) for q in queries]
        scores = [
            branch(query.mean(2))
            for branch, query in zip(self.map_cls_branches, grouped, strict=True)
        ]
        points = [a.view(*shape, 2) for a in at]
        boxes = [_enclosing(p) for p in points]
        return MapOutputs(
            torch.stack(scores), torch.stack(boxes), torch.stack(points), grouped[-1]
        )


def _repeat(make: Callable[[int], nn.Module], outputs: int) -> nn.ModuleList:
    return nn.ModuleList(make(outputs) for _ in range(LAYERS))


def _enclosing(points: Tensor) -> Tensor:
    """Return the box (cx, cy, w, h) around the points of every vector."""
    low, high = points.amin(2), points.amax(2)
    return torch.cat([(low + high) / 2, high - low], -1)
