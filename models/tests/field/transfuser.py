"""LEAD's stack (TransFuser v6) in small: its modules and edges, fewer channels.

A camera strip and a LiDAR raster pass two residual networks; between their stages a
transformer mixes tokens of both. Heads draw semantics, the bird's-eye view and boxes;
a transformer decoder plans a route, a target speed and a course.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.resnet import Block

WIDTHS = (32, 64)
"""Channels of the stages, of which the published networks have four."""

IMAGE = (1, 3, 32, 128)
LIDAR = (1, 2, 64, 64)
IMAGE_TOKENS, LIDAR_TOKENS = (2, 8), (4, 4)
WIDTH, HEADS = 64, 4
"""Of all transformers behind the trunk."""


def stem(channels: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels, WIDTHS[0], 7, 2, 3, bias=False),
        nn.BatchNorm2d(WIDTHS[0]),
        nn.ReLU(),
        nn.MaxPool2d(3, 2, 1),
    )


def stages() -> nn.ModuleList:
    before = (WIDTHS[0], *WIDTHS)
    return nn.ModuleList(
        Block(before[at], width, 1 if at == 0 else 2, bottleneck=False)
        for at, width in enumerate(WIDTHS)
    )


def mlp(width: int, out: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(width, WIDTH), nn.ReLU(), nn.Linear(WIDTH, out))


class SelfAttention(nn.Module):
    """Three projections, torch's own attention, one more."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.key, self.query = nn.Linear(width, width), nn.Linear(width, width)
        self.value, self.proj = nn.Linear(width, width), nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """Attend over tokens [n, t, c]."""
        images, tokens, width = x.shape
        form = (images, tokens, HEADS, width // HEADS)
        q, k, v = (
            layer(x).view(form).transpose(1, 2)
            for layer in (self.query, self.key, self.value)
        )
        mixed = functional.scaled_dot_product_attention(q, k, v)
        out: Tensor = self.proj(mixed.transpose(1, 2).reshape(images, tokens, width))
        return out


class FusionBlock(nn.Module):
    """Attention and two layers, each behind a LayerNorm and added."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.ln1, self.ln2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attn = SelfAttention(width)
        self.mlp = nn.Sequential(
            nn.Linear(width, 4 * width), nn.ReLU(), nn.Linear(4 * width, width)
        )

    def forward(self, x: Tensor) -> Tensor:
        """Map tokens [n, t, c]."""
        x = x + self.attn(self.ln1(x))
        out: Tensor = x + self.mlp(self.ln2(x))
        return out


class Fusion(nn.Module):
    """Tokens of both maps, pooled, mixed, and added to the maps that they are of."""

    def __init__(self, width: int) -> None:
        super().__init__()
        tokens = math.prod(IMAGE_TOKENS) + math.prod(LIDAR_TOKENS)
        self.pos_emb = nn.Parameter(0.02 * torch.randn(1, tokens, width))
        self.image_pool = nn.AdaptiveAvgPool2d(IMAGE_TOKENS)
        self.lidar_pool = nn.AdaptiveAvgPool2d(LIDAR_TOKENS)
        self.lidar_to_image = nn.Conv2d(width, width, 1)
        self.image_to_lidar = nn.Conv2d(width, width, 1)
        self.block = FusionBlock(width)
        self.ln_f = nn.LayerNorm(width)

    def forward(self, image: Tensor, lidar: Tensor) -> tuple[Tensor, Tensor]:
        """Mix two maps [n, c, h, w] of sizes of their own."""
        width = image.shape[1]
        pooled = self.image_pool(image), self.lidar_pool(self.image_to_lidar(lidar))
        tokens = torch.cat([part.flatten(2).transpose(1, 2) for part in pooled], 1)
        mixed = self.ln_f(self.block(tokens + self.pos_emb))
        count = math.prod(IMAGE_TOKENS)
        parts = mixed[:, :count], mixed[:, count:]
        maps = [
            part.transpose(1, 2).reshape(-1, width, *size)
            for part, size in zip(parts, (IMAGE_TOKENS, LIDAR_TOKENS), strict=True)
        ]
        maps[1] = self.lidar_to_image(maps[1])
        return image + enlarged(maps[0], image), lidar + enlarged(maps[1], lidar)


def enlarged(small: Tensor, to: Tensor) -> Tensor:
    """Enlarge a map to the size of another, which a trace takes as fixed."""
    size = [int(side) for side in to.shape[2:]]
    return functional.interpolate(small, size, mode="bilinear", align_corners=False)


class Trunk(nn.Module):
    """Both networks with a fusion behind each stage, and the upward path of the BEV."""

    def __init__(self) -> None:
        super().__init__()
        self.image_stem, self.lidar_stem = stem(IMAGE[1]), stem(LIDAR[1])
        self.image_stages, self.lidar_stages = stages(), stages()
        self.fusions = nn.ModuleList(Fusion(width) for width in WIDTHS)
        self.c5 = nn.Conv2d(WIDTHS[-1], WIDTH, 1)
        self.up5 = nn.Conv2d(WIDTH, WIDTH, 3, padding=1)
        self.up4 = nn.Conv2d(WIDTH, WIDTH, 3, padding=1)

    def forward(self, image: Tensor, lidar: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Give the last map of the images, the BEV's, and that enlarged four times."""
        image, lidar = self.image_stem(image), self.lidar_stem(lidar)
        for of_image, of_lidar, fuse in zip(
            self.image_stages, self.lidar_stages, self.fusions, strict=True
        ):
            image, lidar = fuse(of_image(image), of_lidar(lidar))
        up = functional.relu(self.c5(lidar))
        for layer in (self.up5, self.up4):
            twice = functional.interpolate(up, scale_factor=2.0, mode="bilinear")
            up = functional.relu(layer(twice))
        return image, lidar, up


class SineEmbedding(nn.Module):
    """Sines and cosines of a map's rows and columns, after DETR."""

    def forward(self, x: Tensor) -> Tensor:
        """Give [1, c, h, w] for a map [n, c, h, w]."""
        ones = torch.ones_like(x[:1, 0])
        rows, columns = ones.cumsum(1), ones.cumsum(2)
        steps = torch.arange(WIDTH // 2, dtype=torch.float32)
        periods = 10000 ** (2 * torch.div(steps, 2, rounding_mode="floor") / WIDTH * 2)
        parts = []
        for places, size in ((rows, x.shape[2]), (columns, x.shape[3])):
            turns = (places / size * 2 * math.pi)[..., None] / periods
            both = torch.stack((turns[..., 0::2].sin(), turns[..., 1::2].cos()), 4)
            parts.append(both.flatten(3))
        return torch.cat(parts, 3).permute(0, 3, 1, 2)


class Centres(nn.Module):
    """CenterNet's heads, and the best of the centres that are local peaks."""

    def __init__(self, classes: int = 4, best: int = 8) -> None:
        super().__init__()
        self.best = best
        outs = {"heat": classes, "offset": 2, "size": 2, "yaw_class": 12, "yaw_res": 1}
        self.heads = nn.ModuleDict(
            {
                name: nn.Sequential(
                    nn.Conv2d(WIDTH, WIDTH, 3, padding=1),
                    nn.ReLU(),
                    nn.Conv2d(WIDTH, out, 1),
                )
                for name, out in outs.items()
            }
        )

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Give the heat [n, classes, h, w] and boxes [n, best, 7]."""
        maps = {name: head(x) for name, head in self.heads.items()}
        heat = maps["heat"].sigmoid()
        peaks = heat * (functional.max_pool2d(heat, 3, 1, 1) == heat).float()
        height, width = heat.shape[2:]
        scores, at = peaks.flatten(1).topk(self.best)
        label, cell = at // (height * width), at % (height * width)
        chosen = {}
        for name in ("offset", "size", "yaw_class", "yaw_res"):
            flat = maps[name].flatten(2).transpose(1, 2)
            where = cell[..., None].expand(-1, -1, flat.shape[2])
            chosen[name] = flat.gather(1, where)
        centre = torch.stack((cell % width, cell // width), -1) + chosen["offset"]
        turn = chosen["yaw_class"].argmax(-1, keepdim=True) * (math.pi / 6)
        parts = (centre, chosen["size"], turn + chosen["yaw_res"], scores[..., None])
        return heat, torch.cat((*parts, label[..., None].float()), -1)


def picture_head(channels: int, classes: int) -> nn.Sequential:
    """Draw a picture of twice the size of the map's."""
    return nn.Sequential(
        nn.Conv2d(channels, WIDTH, 3, padding=1),
        nn.ReLU(),
        nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False),
        nn.Conv2d(WIDTH, classes, 3, padding=1),
    )


class Radar(nn.Module):
    """Radar points read the BEV at their places; queries gather them to objects."""

    def __init__(self, sensors: int = 4, queries: int = 5) -> None:
        super().__init__()
        self.sensors = sensors
        self.bev_proj, self.speed = nn.Conv2d(WIDTHS[-1], WIDTH, 1), nn.Linear(1, WIDTH)
        self.tokenizer = mlp(WIDTH + 1 + sensors, WIDTH)
        self.q = nn.Parameter(torch.randn(1, queries, WIDTH))
        self.tf = decoder(layers=1)
        self.state = mlp(WIDTH, 3)

    def forward(self, bev: Tensor, points: Tensor, speed: Tensor) -> tuple[Tensor, ...]:
        """Map points [n, p, 4]: places, speed, sensor; give tokens and states."""
        bev = self.bev_proj(bev)
        at = points[:, :, None, :2] / 32
        read = functional.grid_sample(bev, at, align_corners=False)[..., 0].transpose(
            1, 2
        )
        sensor = functional.one_hot(points[..., 3].long(), self.sensors).float()
        tokens = self.tokenizer(torch.cat((read, points[..., 2:3] / 20, sensor), -1))
        own = self.speed(speed / 20)[:, None]
        memory = torch.cat((bev.flatten(2).transpose(1, 2), own, tokens), 1)
        features = self.tf(self.q.repeat(len(bev), 1, 1), memory)
        raw = self.state(features)
        states = raw.clone()
        states[..., :2] = torch.tanh(raw[..., :2]) * 32
        states[..., 2] = (torch.tanh(raw[..., 2]) + 1) * 10
        return features, states


def decoder(layers: int) -> nn.TransformerDecoder:
    layer = nn.TransformerDecoderLayer(
        WIDTH, HEADS, 4 * WIDTH, activation=nn.GELU(), batch_first=True
    )
    return nn.TransformerDecoder(layer, layers, nn.LayerNorm(WIDTH))


class Planner(nn.Module):
    """Queries for route, course and target speed read the BEV and the ego's state."""

    def __init__(self, route: int = 20, course: int = 8) -> None:
        super().__init__()
        self.sizes = (route, course, 1)
        self.queries = nn.Parameter(torch.rand(1, sum(self.sizes), WIDTH))
        self.position, self.adapter = SineEmbedding(), nn.Conv2d(WIDTHS[-1], WIDTH, 1)
        self.status_position = nn.Parameter(torch.rand(1, 4 + 5, WIDTH))
        self.normalise = nn.BatchNorm1d(1, affine=False)
        self.speed_encoder, self.goal_encoder = nn.Linear(1, WIDTH), nn.Linear(2, WIDTH)
        self.radar_encoder = nn.Linear(WIDTH, WIDTH)
        self.decoder = decoder(layers=1)
        self.route, self.course = nn.Linear(WIDTH, 2), nn.GRU(WIDTH, 32, 1, True, True)
        self.step, self.speed = nn.Linear(32, 2), mlp(WIDTH, 8)
        self.register_buffer("classes", torch.arange(8) * 4.0)

    def forward(
        self, bev: Tensor, radar: Tensor, speed: Tensor, goals: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Give points of the route and of the course, metres, and a speed, m/s."""
        bev = self.adapter(bev)
        memory = (bev + self.position(bev)).flatten(2).transpose(1, 2)
        ego = self.speed_encoder(self.normalise(speed))[:, None]
        goal = self.goal_encoder(goals / goals.new_tensor((200, 50)))
        status = torch.cat((ego, goal, self.radar_encoder(radar)), 1)
        memory = torch.cat((memory, status + self.status_position), 1)
        queries = self.decoder(self.queries.repeat(len(bev), 1, 1), memory)
        route, course, target = queries.split(self.sizes, 1)
        steps = self.step(self.course(course)[0])
        odds = self.speed(target[:, 0]).softmax(-1)
        return self.route(route).cumsum(1), steps.cumsum(1), odds @ self.classes


def normalised(image: Tensor) -> Tensor:
    """Normalise channel by channel, in place, as LEAD does."""
    image = image.clone()
    means, spreads = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
    for channel, (mean, spread) in enumerate(zip(means, spreads, strict=True)):
        image[:, channel] = (image[:, channel] / 255 - mean) / spread
    return image


class Lead(nn.Module):
    """The whole stack."""

    def __init__(self) -> None:
        super().__init__()
        self.backbone, self.radar, self.planner = Trunk(), Radar(), Planner()
        self.semantic_decoder = picture_head(WIDTHS[-1], 7)
        self.bev_decoder, self.center_net = picture_head(WIDTH, 6), Centres()

    def forward(
        self, image: Tensor, lidar: Tensor, points: Tensor, speed: Tensor, goals: Tensor
    ) -> tuple[Tensor, ...]:
        """Give route, course, speed, semantic and BEV pictures, heat, boxes, radar."""
        seen, bev, up = self.backbone(normalised(image), lidar)
        tokens, states = self.radar(bev, points, speed)
        planned = self.planner(bev, tokens, speed, goals)
        pictures = self.semantic_decoder(seen), self.bev_decoder(up)
        return *planned, *pictures, *self.center_net(up), states


@dataclass(frozen=True)
class FieldStack:
    """A stack and its interface.

    Attributes:
        build: makes it.
        inputs: shapes.
        outputs: names.
    """

    build: type[nn.Module]
    inputs: dict[str, tuple[int, ...]]
    outputs: tuple[str, ...]


LEAD = FieldStack(
    Lead,
    {
        "image": IMAGE,
        "lidar": LIDAR,
        "points": (1, 40, 4),
        "speed": (1, 1),
        "goals": (1, 3, 2),
    },
    ("route", "course", "target", "semantic", "bev", "heat", "boxes", "radar"),
)
