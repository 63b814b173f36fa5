"""The perception part of the head: queries, boxes and map vectors."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from models.bev.decoder import Decoded, Decoder, detections
from models.bev.encoder import GridPosition
from models.bev.layers import classifier, mlp
from models.bev.sizes import BOX_CODE, EMBED, Sampling
from models.bev.transformer import BevTransformer, Motions
from models.regions import region
from models.vad.config import LAYERS, Heads, VadConfig


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


class PerceptionTransformer(BevTransformer):
    """BEV encoder, detection decoder and map decoder."""

    def __init__(self, sampling: Sampling, config: VadConfig) -> None:
        grid = config.grid
        super().__init__(grid, config.image_hw, config.feature_hws, LAYERS, sampling)
        self.reference_points = nn.Linear(EMBED, 3)
        self.decoder = Decoder(grid.hw, LAYERS, sampling, height=True)
        self.map_reference_points = nn.Linear(EMBED, 2)
        self.map_decoder = Decoder(grid.hw, LAYERS, sampling, height=False)

    def forward(
        self,
        features: Tensor,
        cells: tuple[Tensor, Tensor],
        agents: Tensor,
        points: Tensor,
        branches: tuple[nn.ModuleList, nn.ModuleList],
        motions: Motions,
    ) -> tuple[Tensor, Decoded, Decoded]:
        """Encode features [cameras, 256, h, w] and decode agents and map points.

        ``cells`` are BEV queries and their positions, [1, cells, 256] each; ``agents``
        [300, 512] and ``points`` [2000, 512] are position then content; ``branches``
        are those of detection and map. Returns the BEV [1, cells, 256] and the results
        of both `Decoder`s.
        """
        with region("bev_encoder"):
            (tokens,) = self.tokens([features])
            bev = self.bev(tokens, cells, motions)
        with region("det"):
            pos, query = agents.unsqueeze(0).chunk(2, dim=2)
            at = self.reference_points(pos).sigmoid()
            found = self.decoder(query, pos, bev, at, branches[0])
        with region("map"):
            pos, query = points.unsqueeze(0).chunk(2, dim=2)
            at = self.map_reference_points(pos).sigmoid()
            mapped = self.map_decoder(query, pos, bev, at, branches[1])
        return bev, found, mapped


class PerceptionHead(nn.Module):
    """Queries, their transformer, and the branches that read it."""

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
        self.cls_branches = _repeat(lambda: classifier(heads.det_classes))
        self.reg_branches = _repeat(lambda: mlp(EMBED, EMBED, EMBED, BOX_CODE))
        self.map_cls_branches = _repeat(lambda: classifier(heads.map_classes))
        self.map_reg_branches = _repeat(lambda: mlp(EMBED, EMBED, EMBED, 2))

    def perceive(
        self, features: Tensor, motions: Motions
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
            motions,
        )
        with region("det"):
            agents = self._agents(found)
        with region("map"):
            vectors = self._map(mapped)
        return bev, agents, vectors

    def _agents(self, decoded: Decoded) -> AgentOutputs:
        scores, boxes = detections(decoded, self.cls_branches, self.config.grid)
        queries, _, at = decoded
        return AgentOutputs(scores, boxes, queries[-1], at[-1][..., :2])

    def _map(self, decoded: Decoded) -> MapOutputs:
        queries, _, at = decoded
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


def _repeat(make: Callable[[], nn.Module]) -> nn.ModuleList:
    return nn.ModuleList(make() for _ in range(LAYERS))


def _enclosing(points: Tensor) -> Tensor:
    """Return the box (cx, cy, w, h) around the points of every vector."""
    low, high = points.amin(2), points.amax(2)
    return torch.cat([(low + high) / 2, high - low], -1)
