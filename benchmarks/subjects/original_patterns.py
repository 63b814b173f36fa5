"""VAD-tiny of models/ in the forms of the original code (hustvl/VAD).

models/ writes the network more thriftily than the published code does. Here the same
weights compute the same outputs in the original's way, so that a measurement says what
the passes do for who exports that:

* camera attention: the queries are repeated for six cameras before they are projected;
* sampling offsets are divided by the map's size, an integer tensor;
* pillars are projected by matrices that are repeated for every cell;
* both halves of the temporal queue are averaged over their last axis;
* attention is PyTorch's, of sequences first, with heads merged into the batch;
* motion reads the map with keys, values and positions of its own for every agent and
  mode, [101, 1800, 256], and an empty vector behind the 100 of the map;
* references and boxes are made by assignment to slices.
"""

from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.bev.attention import (
    DecoderAttention,
    MultiheadAttention,
    PackedAttention,
    deformable_attention,
)
from models.bev.decoder import Decoded, Decoder
from models.bev.encoder import (
    BevEncoder,
    CameraAttention,
    TemporalSelfAttention,
)
from models.bev.sizes import ATTENTION_HEADS, CAMERAS, EMBED, PILLAR_POINTS
from models.export import build, save, trace
from models.stacks import VAD_TINY
from models.vad.config import MAP_REACH, MAP_SCORE
from models.vad.perception import AgentOutputs, MapOutputs
from models.vad.planner import PlanningHead

NAME = "vad-tiny-original"
OF = "vad-tiny"
"""The stack whose weights and frames it has."""
OPSET = 17
READS_MAP = "pts_bbox_head.motion_map_decoder"
EPSILON = 1e-5
"""Least depth in metres, and what keeps the inverse sigmoid finite (hustvl/VAD)."""


def export(path: Path) -> None:
    """Write the ONNX file, with the metadata of the stack's."""
    spec = VAD_TINY.with_heads(None)
    save(trace(spec, original(), OPSET), spec.metadata(), path)


def original(seed: int = 0) -> nn.Module:
    """Build the stack with its weights, in the original's forms."""
    return restored(build(OF, seed=seed))


def restored(model: nn.Module) -> nn.Module:
    """Give a stack of models/ the original's code, in place.

    Motion's map attention gets sequences first; in front of the others stand the
    transpositions that the original has around its layers.
    """
    for name, module in model.named_modules():
        form = FORMS.get(type(module))
        given = name.startswith(READS_MAP) and form is Attention
        if form is not None and not given:
            module.__class__ = form
    return model


class Projections(PackedAttention):
    """PyTorch's multi-head attention of queries [Q, B, 256] and keys [K, B, 256]."""

    def forward(
        self, query: Tensor, key: Tensor, value: Tensor, ignore: Tensor | None = None
    ) -> Tensor:
        read, _ = functional.multi_head_attention_forward(
            query, key, value, EMBED, ATTENTION_HEADS,
            self.in_proj_weight, self.in_proj_bias, None, None, False, 0.0,
            self.out_proj.weight, self.out_proj.bias,
            training=False, key_padding_mask=ignore,
        )  # fmt: skip
        return read


class Attention(MultiheadAttention):
    """Attention of [B, Q, 256], which goes through [Q, B, 256]."""

    def forward(
        self,
        query: Tensor,
        key: Tensor,
        query_pos: Tensor | None = None,
        key_pos: Tensor | None = None,
        ignore: Tensor | None = None,
    ) -> Tensor:
        asked, offered = query.permute(1, 0, 2), key.permute(1, 0, 2)
        at, there = (
            None if pos is None else pos.permute(1, 0, 2)
            for pos in (query_pos, key_pos)
        )
        return super().forward(asked, offered, at, there, ignore).permute(1, 0, 2)


def _sizes(hws: tuple[tuple[int, int], ...]) -> Tensor:
    """Return width and height of every level, [1, 1, 1, levels, 1, 2] int64."""
    shapes = torch.tensor(hws)
    return torch.stack([shapes[..., 1], shapes[..., 0]], -1)[None, None, None, :, None]


class Cameras(CameraAttention):
    """Offsets and weights are computed for every camera, from repeated queries."""

    def forward(self, query: Tensor, tokens: Tensor, at: Tensor) -> Tensor:
        cells, levels, points = query.shape[1], len(self.hws), self.points
        queries = query.unsqueeze(1).repeat(1, CAMERAS, 1, 1)
        queries = queries.view(CAMERAS, cells, EMBED)
        value = self.value_proj(tokens)
        value = value.view(CAMERAS, tokens.shape[1], ATTENTION_HEADS, -1)
        # One set of samples a level, spread over the points of the pillar
        each = CAMERAS, cells, ATTENTION_HEADS, levels
        offsets = self.sampling_offsets(queries).view(*each, points, 2)
        weights = self.attention_weights(queries).view(*each[:3], levels * points)
        weights = weights.softmax(-1).view(*each, points)
        offsets = offsets / _sizes(self.hws)
        offsets = offsets.view(*each, points // PILLAR_POINTS, PILLAR_POINTS, 2)
        locations = at[:, :, None, None, None, :, :] + offsets
        locations = locations.view(*each, points, 2)
        return deformable_attention(value, self.hws, locations, weights, self.sampling)


class Temporal(TemporalSelfAttention):
    """Both halves of the queue are averaged over the last axis."""

    def forward(self, query: Tensor, pos: Tensor, queue: Tensor, at: Tensor) -> Tensor:
        asked = torch.cat([queue[:1], query + pos], -1)
        cells, halves, points = asked.shape[1], self.queue, self.points
        value = self.value_proj(queue).reshape(halves, cells, ATTENTION_HEADS, -1)
        offsets = self.sampling_offsets(asked)
        offsets = offsets.view(1, cells, ATTENTION_HEADS, halves, 1, points, 2)
        weights = self.attention_weights(asked)
        weights = weights.view(1, cells, ATTENTION_HEADS, halves, points).softmax(-1)
        weights = weights.view(1, cells, ATTENTION_HEADS, halves, 1, points)
        # The halves become the batch
        each = halves, cells, ATTENTION_HEADS, 1, points
        weights = weights.permute(0, 3, 1, 2, 4, 5).reshape(*each)
        offsets = offsets.permute(0, 3, 1, 2, 4, 5, 6).reshape(*each, 2)
        places = torch.stack([at, at], 1).reshape(halves, cells, 1, 2)
        locations = places[:, :, None, :, None, :] + offsets / _sizes((self.hw,))
        out = deformable_attention(value, (self.hw,), locations, weights, self.sampling)
        out = out.permute(1, 2, 0).view(cells, EMBED, 1, halves).mean(-1)
        read: Tensor = self.output_proj(out.permute(2, 0, 1))
        return query + read


class Reading(DecoderAttention):
    """Offsets are divided by the size of the map, an integer tensor."""

    def _locations(self, at: Tensor, offsets: Tensor) -> Tensor:
        return at + offsets / _sizes((self.hw,))


class Encoder(BevEncoder):
    """Pillars are projected by a matrix for every cell, and scaled in place."""

    def forward(
        self,
        query: Tensor,
        pos: Tensor,
        previous: Tensor,
        first: Tensor,
        shift: Tensor,
        tokens: Tensor,
        lidar2img: Tensor,
    ) -> Tensor:
        pillars_at, visible = _projected(self.pillars, lidar2img, self.image_hw)
        cells_at = self.cells + shift[:, None]
        start = query
        for layer in self.layers:
            older = torch.where(first, query, previous)
            newer = torch.where(first, query, start)
            queue = torch.stack([older, newer], 1).reshape(2, -1, EMBED)
            query = layer(query, (pos, queue, cells_at), (tokens, pillars_at, visible))
        return query


def _projected(
    pillars: Tensor, lidar2img: Tensor, image_hw: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    heights, cells = pillars.shape[:2]
    points = pillars.view(heights, 1, 1, cells, 4).repeat(1, 1, CAMERAS, 1, 1)
    matrices = lidar2img.view(1, 1, CAMERAS, 1, 4, 4).repeat(heights, 1, 1, cells, 1, 1)
    seen = torch.matmul(matrices, points.unsqueeze(-1)).squeeze(-1)
    depth = seen[..., 2:3]
    inside = depth > EPSILON
    uv = seen[..., 0:2] / torch.maximum(depth, torch.ones_like(depth) * EPSILON)
    uv[..., 0] /= image_hw[1]
    uv[..., 1] /= image_hw[0]
    for part in (uv[..., 0:1], uv[..., 1:2]):
        inside = inside & (part > 0.0) & (part < 1.0)
    uv, inside = (each.permute(2, 1, 3, 0, 4) for each in (uv, inside))
    visible = (inside.squeeze(-1).sum(-1) > 0).to(uv.dtype).permute(0, 2, 1)
    return uv.squeeze(1), visible


def inverse_sigmoid(x: Tensor) -> Tensor:
    """Return the logit of x, clamped."""
    x = x.clamp(min=0, max=1)
    return torch.log(x.clamp(min=EPSILON) / (1 - x).clamp(min=EPSILON))


class Refining(Decoder):
    """The moved references are assigned to slices of zeros."""

    def forward(
        self,
        query: Tensor,
        pos: Tensor,
        bev: Tensor,
        reference: Tensor,
        branches: nn.ModuleList,
        ignore: Tensor | None = None,
    ) -> Decoded:
        queries, regressions, references = [], [], []
        for layer, branch in zip(self.layers, branches, strict=True):
            known = query, pos, pos, ignore
            query = layer(query, known, (pos, bev, reference[..., :2]))
            raw = branch(query)
            moved = torch.zeros_like(reference)
            moved[..., :2] = raw[..., :2] + inverse_sigmoid(reference[..., :2])
            if self.height:
                moved[..., 2:3] = raw[..., 4:5] + inverse_sigmoid(reference[..., 2:3])
            reference = moved.sigmoid()
            queries.append(query)
            regressions.append(raw)
            references.append(reference)
        return queries, regressions, references


class Head(PlanningHead):
    """Boxes are written in place; motion reads keys of its own for every agent."""

    def _agents(self, decoded: Decoded) -> AgentOutputs:
        queries, regressions, references = decoded
        x0, y0, z0, x1, y1, z1 = self.config.grid.pc_range
        told = zip(self.cls_branches, queries, strict=True)
        scores = [branch(each) for branch, each in told]
        boxes = []
        for raw, at in zip(regressions, references, strict=True):
            box = raw.clone()
            box[..., 0:2] = at[..., 0:2]
            box[..., 4:5] = at[..., 2:3]
            box[..., 0:1] = box[..., 0:1] * (x1 - x0) + x0
            box[..., 1:2] = box[..., 1:2] * (y1 - y0) + y0
            box[..., 4:5] = box[..., 4:5] * (z1 - z0) + z0
            boxes.append(box)
        found = torch.stack(scores), torch.stack(boxes)
        return AgentOutputs(*found, queries[-1], references[-1][..., :2])

    def _read_map(
        self,
        query: Tensor,
        centres: Tensor,
        vectors: MapOutputs,
        lanes: tuple[Tensor, Tensor],
    ) -> Tensor:
        lane_query, lane_at = lanes
        rows = centres.shape[1]
        # Every agent and mode gets its own copy of the vectors, and their positions
        key = lane_query.unsqueeze(1).repeat(1, rows, 1, 1)
        at = lane_at.unsqueeze(1).repeat(1, rows, 1, 1) - centres[:, :, None, :]
        unlikely = vectors.scores[-1].sigmoid().amax(-1) <= MAP_SCORE
        far = torch.sqrt(at[..., 0] ** 2 + at[..., 1] ** 2) > MAP_REACH
        ignore = torch.logical_or(unlikely.unsqueeze(1).repeat(1, rows, 1), far)
        # and an empty vector, which is always seen
        key, at, ignore = (each.flatten(0, 1) for each in (key, at, ignore))
        key = torch.cat([key, torch.zeros(rows, 1, EMBED)], 1).permute(1, 0, 2)
        at = torch.cat([at, torch.zeros(rows, 1, 2)], 1).permute(1, 0, 2)
        ignore = torch.cat([ignore, torch.tensor([False])[None].repeat(rows, 1)], 1)
        key_pos, query_pos = self.pos_mlp(at), self.pos_mlp(torch.zeros(1, rows, 2))
        read: Tensor = self.motion_map_decoder(query, key, query_pos, key_pos, ignore)
        return read


FORMS: dict[type[nn.Module], type[nn.Module]] = {
    PackedAttention: Projections,
    MultiheadAttention: Attention,
    CameraAttention: Cameras,
    TemporalSelfAttention: Temporal,
    DecoderAttention: Reading,
    BevEncoder: Encoder,
    Decoder: Refining,
    PlanningHead: Head,
}
"""The original's form of each module of models/."""
