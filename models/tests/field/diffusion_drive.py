"""DiffusionDrive in small: TransFuser's trunk and a truncated diffusion of 20 anchors.

The noise is an input and both steps of DDIM are written out, as an export must have it.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.tests.field.transfuser import (
    HEADS,
    IMAGE,
    LIDAR,
    WIDTH,
    WIDTHS,
    FieldStack,
    Trunk,
    mlp,
    picture_head,
)

ANCHORS, POSES, AGENTS = 20, 8, 6
STEPS = (10, 0)
"""Of 1,000 that the model was trained with; noise is added at the eighth."""


def sines(positions: Tensor, width: int) -> Tensor:
    """Embed numbers [...] as [..., width], half sines and half cosines."""
    half = width // 2
    rates = torch.exp(torch.arange(half) * -(math.log(10000) / (half - 1)))
    turns = positions[..., None] * rates
    return torch.cat((turns.sin(), turns.cos()), -1)


class SampledAttention(nn.Module):
    """Every anchor reads the BEV at its own points, weighed."""

    def __init__(self) -> None:
        super().__init__()
        self.weights, self.output = nn.Linear(WIDTH, POSES), nn.Linear(WIDTH, WIDTH)
        self.value = nn.Sequential(nn.Conv2d(WIDTH, WIDTH, 3, 1, 1), nn.ReLU())

    def forward(self, query: Tensor, points: Tensor, bev: Tensor) -> Tensor:
        """Map [n, a, c] with points [n, a, p, 2] in metres and a map [n, c, h, w]."""
        grid = torch.stack((points[..., 1] / 32, points[..., 0] / 32), -1)
        shares = self.weights(query).softmax(-1)
        read = functional.grid_sample(
            self.value(bev), grid, padding_mode="zeros", align_corners=False
        )
        mixed = torch.einsum("nap,ncap->nac", shares, read)
        out: Tensor = query + self.output(mixed)
        return out


class DecoderLayer(nn.Module):
    """Anchors read BEV, agents and ego, are modulated by time, and are refined."""

    def __init__(self) -> None:
        super().__init__()
        self.bev = SampledAttention()
        self.agents = nn.MultiheadAttention(WIDTH, HEADS, batch_first=True)
        self.ego = nn.MultiheadAttention(WIDTH, HEADS, batch_first=True)
        self.ffn = nn.Sequential(
            nn.Linear(WIDTH, 2 * WIDTH), nn.ReLU(), nn.Linear(2 * WIDTH, WIDTH)
        )
        self.norms = nn.ModuleList(nn.LayerNorm(WIDTH) for _ in range(3))
        self.modulate = nn.Sequential(nn.Mish(), nn.Linear(WIDTH, 2 * WIDTH))
        self.score = nn.Sequential(
            nn.Linear(WIDTH, WIDTH), nn.ReLU(), nn.LayerNorm(WIDTH), nn.Linear(WIDTH, 1)
        )
        self.offset = mlp(WIDTH, 3 * POSES)

    def forward(
        self,
        query: Tensor,
        points: Tensor,
        bev: Tensor,
        agents: Tensor,
        ego: Tensor,
        time: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Give features, poses [n, a, p, 3] in metres and radians, and scores."""
        query = self.bev(query, points, bev)
        query = self.norms[0](query + self.agents(query, agents, agents)[0])
        query = self.norms[1](query + self.ego(query, ego, ego)[0])
        query = self.norms[2](self.ffn(query))
        scale, shift = self.modulate(time)[:, None].chunk(2, -1)
        query = query * (1 + scale) + shift
        poses = self.offset(query).view(-1, ANCHORS, POSES, 3)
        at, heading = poses[..., :2] + points, poses[..., 2:].tanh() * math.pi
        return query, torch.cat((at, heading), -1), self.score(query)[..., 0]


class DiffusionDrive(nn.Module):
    """The whole stack."""

    def __init__(self) -> None:
        super().__init__()
        self.trunk = Trunk()
        self.query = nn.Embedding(1 + AGENTS, WIDTH)
        self.keys, self.status = nn.Conv2d(WIDTHS[-1], WIDTH, 1), nn.Linear(8, WIDTH)
        cells = math.prod(LIDAR[2:]) // (2 * 2 ** len(WIDTHS)) ** 2
        self.places = nn.Embedding(cells + 1, WIDTH)
        layer = nn.TransformerDecoderLayer(WIDTH, HEADS, 128, batch_first=True)
        self.decoder = nn.TransformerDecoder(layer, 1)
        self.bev_head, self.boxes = picture_head(WIDTH, 7), mlp(WIDTH, 5)
        self.labels = nn.Linear(WIDTH, 1)
        ways = torch.linspace(0.1, 1, POSES)[None, :, None] * 30
        turns = torch.linspace(-1, 1, ANCHORS)[:, None] * ways[..., 0] / 30
        anchors = torch.stack((ways[..., 0] * turns.cos(), ways[..., 0] * turns.sin()))
        self.register_buffer("anchors", anchors.permute(1, 2, 0)[None])
        self.encode = nn.Sequential(
            nn.Linear(POSES * 32, WIDTH), nn.ReLU(), nn.LayerNorm(WIDTH),
            nn.Linear(WIDTH, WIDTH),
        )  # fmt: skip
        self.time = nn.Sequential(
            nn.Linear(WIDTH, 4 * WIDTH), nn.Mish(), nn.Linear(4 * WIDTH, WIDTH)
        )
        self.layers = nn.ModuleList(DecoderLayer() for _ in range(1))
        kept = (1 - torch.linspace(1e-4**0.5, 0.02**0.5, 1000) ** 2).cumprod(0)
        self.register_buffer("kept", kept)

    def forward(
        self, image: Tensor, lidar: Tensor, status: Tensor, noise: Tensor
    ) -> tuple[Tensor, ...]:
        """Give the chosen course, all courses, scores, boxes, labels and the BEV."""
        _, last, up = self.trunk(image, lidar)
        ego_state = self.status(status)
        keys = self.keys(last).flatten(2).transpose(1, 2)
        keys = torch.cat((keys, ego_state[:, None]), 1) + self.places.weight[None]
        queries = self.query.weight[None].expand(len(image), -1, -1)
        ego, agents = self.decoder(queries, keys).split((1, AGENTS), 1)
        boxes, labels = self.boxes(agents), self.labels(agents)[..., 0]
        at = torch.cat((boxes[..., :2].tanh() * 32, boxes[..., 2:]), -1)
        courses, scores = self.denoised(noise, up, agents, ego)
        best = scores.argmax(-1)[:, None, None, None].expand(-1, 1, POSES, 3)
        course = courses.gather(1, best)[:, 0]
        return course, courses, scores, at, labels, self.bev_head(up)

    def denoised(
        self, noise: Tensor, bev: Tensor, agents: Tensor, ego: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Take both steps from anchors with noise; courses are within 32 m."""
        kept, anchors = self.get_buffer("kept"), self.get_buffer("anchors")
        noisy = kept[8].sqrt() * anchors / 32 + (1 - kept[8]).sqrt() * noise
        courses, scores = noisy, noisy
        for step, after in zip(STEPS, (*STEPS[1:], None), strict=True):
            points = noisy.clamp(-1, 1) * 32
            query = self.encode(sines(points, 16).flatten(2))
            now = torch.full((len(noise),), step, dtype=torch.int64)
            time = self.time(sines(now.float(), WIDTH))
            for layer in self.layers:
                query, courses, scores = layer(query, points, bev, agents, ego, time)
                points = courses[..., :2]
            clean = (courses[..., :2] / 32).clamp(-1, 1)
            drift = (noisy - kept[step].sqrt() * clean) / (1 - kept[step]).sqrt()
            if after is not None:
                noisy = kept[after].sqrt() * clean + (1 - kept[after]).sqrt() * drift
        return courses, scores


DIFFUSION_DRIVE = FieldStack(
    DiffusionDrive,
    {
        "image": IMAGE,
        "lidar": LIDAR,
        "status": (1, 8),
        "noise": (1, ANCHORS, POSES, 2),
    },
    ("course", "courses", "scores", "boxes", "labels", "bev"),
)
