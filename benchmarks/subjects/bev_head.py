"""A BEV head as UniAD and VAD have it, random, and frames for it.

Three encoder layers of deformable attention over 2,500 BEV cells and six cameras, two
decoder layers of 900 queries, a motion attention of 300, and a planner of one query:
long attention, short attention, and layers that degenerate to matrix-vector products.
"""

import json
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

WIDTH, HEADS, CAMERAS = 256, 8, 6
SIDE, QUERIES, AGENTS = 50, 900, 300
ROWS, COLUMNS = 15, 25
"""Of the feature map of one camera."""

MAP = """
[modules.bev_encoder]
role = "feature"
patterns = ["encoder", "can"]
[modules.det]
role = "prediction"
patterns = ["decoder", "refer", "scores", "boxes"]
[modules.motion]
role = "prediction"
patterns = ["motion"]
[modules.planner]
role = "prediction"
patterns = ["attend_plan", "norm_plan", "planner"]
"""


class Attention(nn.Module):
    """Multi-head attention."""

    def __init__(self) -> None:
        super().__init__()
        self.q, self.k, self.v, self.o = (nn.Linear(WIDTH, WIDTH) for _ in range(4))

    def forward(self, query: Tensor, key: Tensor) -> Tensor:
        q, k, v = self.q(query), self.k(key), self.v(key)
        q, k, v = (
            x.view(x.shape[0], x.shape[1], HEADS, -1).transpose(1, 2) for x in (q, k, v)
        )
        scores = torch.matmul(q * (WIDTH // HEADS) ** -0.5, k.transpose(2, 3))
        mixed = torch.matmul(scores.softmax(-1), v).transpose(1, 2).flatten(2)
        out: Tensor = self.o(mixed)
        return out


class Deformable(nn.Module):
    """Deformable attention to one level, sampled by grid_sample."""

    def __init__(self, points: int) -> None:
        super().__init__()
        self.points = points
        self.offsets = nn.Linear(WIDTH, HEADS * points * 2)
        self.weights = nn.Linear(WIDTH, HEADS * points)
        self.v, self.o = nn.Linear(WIDTH, WIDTH), nn.Linear(WIDTH, WIDTH)

    def forward(self, query: Tensor, where: Tensor, value: Tensor, rows: int) -> Tensor:
        batch, count, _ = query.shape
        planes = self.v(value).view(batch, -1, HEADS, WIDTH // HEADS)
        planes = planes.permute(0, 2, 3, 1).reshape(
            batch * HEADS, WIDTH // HEADS, rows, -1
        )
        moved = self.offsets(query).view(batch, count, HEADS, self.points, 2) * 0.1
        grid = ((where[:, :, None, None] + moved) * 2 - 1).transpose(1, 2)
        seen = functional.grid_sample(planes, grid.flatten(0, 1), align_corners=False)
        share = self.weights(query).view(batch, count, HEADS, self.points).softmax(-1)
        share = share.transpose(1, 2).reshape(batch * HEADS, 1, count, self.points)
        mixed = (seen * share).sum(-1).view(batch, WIDTH, count).transpose(1, 2)
        out: Tensor = self.o(mixed)
        return out


def feed_forward(width: int = 512, out: int = WIDTH) -> nn.Sequential:
    """Two layers and a ReLU."""
    return nn.Sequential(nn.Linear(WIDTH, width), nn.ReLU(), nn.Linear(width, out))


class Encoder(nn.Module):
    """One layer of the BEV encoder: the past, the cameras, feed-forward."""

    def __init__(self) -> None:
        super().__init__()
        self.past, self.cameras = Deformable(4), Deformable(8)
        self.forward_block = feed_forward()
        self.norms = nn.ModuleList(nn.LayerNorm(WIDTH) for _ in range(3))

    def forward(
        self, x: Tensor, past: Tensor, cells: Tensor, projected: Tensor, views: Tensor
    ) -> Tensor:
        x = self.norms[0](x + self.past(x, cells, past, SIDE))
        seen = self.cameras(x.expand(CAMERAS, -1, -1), projected, views, ROWS)
        x = self.norms[1](x + seen.mean(0, keepdim=True))
        out: Tensor = self.norms[2](x + self.forward_block(x))
        return out


class Decoder(nn.Module):
    """One layer of the detection decoder."""

    def __init__(self) -> None:
        super().__init__()
        self.among, self.bev = Attention(), Deformable(4)
        self.forward_block = feed_forward()
        self.norms = nn.ModuleList(nn.LayerNorm(WIDTH) for _ in range(3))

    def forward(self, x: Tensor, where: Tensor, bev: Tensor) -> Tensor:
        x = self.norms[0](x + self.among(x, x))
        x = self.norms[1](x + self.bev(x, where, bev, SIDE))
        out: Tensor = self.norms[2](x + self.forward_block(x))
        return out


class Motion(nn.Module):
    """Attention among the first agents."""

    def __init__(self) -> None:
        super().__init__()
        self.among, self.norm = Attention(), nn.LayerNorm(WIDTH)
        self.forward_block = feed_forward()

    def forward(self, x: Tensor) -> Tensor:
        x = self.norm(x + self.among(x, x))
        out: Tensor = x + self.forward_block(x)
        return out


class Head(nn.Module):
    """Camera features to boxes and a plan of six waypoints."""

    def __init__(self) -> None:
        super().__init__()
        self.cells = nn.Parameter(torch.randn(1, SIDE * SIDE, WIDTH))
        self.queries = nn.Parameter(torch.randn(1, QUERIES, WIDTH))
        self.ego = nn.Parameter(torch.randn(1, 1, WIDTH))
        self.can = nn.Sequential(nn.Linear(18, 128), nn.ReLU(), nn.Linear(128, WIDTH))
        self.encoder = nn.ModuleList(Encoder() for _ in range(3))
        self.decoder = nn.ModuleList(Decoder() for _ in range(2))
        self.refer, self.motion = nn.Linear(WIDTH, 2), Motion()
        self.scores, self.boxes = feed_forward(WIDTH, 10), feed_forward(WIDTH, 10)
        self.attend_plan, self.norm_plan = Attention(), nn.LayerNorm(WIDTH)
        self.planner = feed_forward(512, 12)
        steps = (torch.arange(SIDE) + 0.5) / SIDE
        grid = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1)
        self.register_buffer("centres", grid.view(1, -1, 2))

    def forward(
        self, views: Tensor, past: Tensor, projected: Tensor, can_bus: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        bev = self.cells + self.can(can_bus).unsqueeze(1)
        for layer in self.encoder:
            bev = layer(bev, past, self.centres, projected, views)
        x, where = self.queries, self.refer(self.queries).sigmoid()
        for layer in self.decoder:
            x = layer(x, where, bev)
        agents = self.motion(x[:, :AGENTS])
        ego = self.norm_plan(self.ego + self.attend_plan(self.ego, agents))
        plan = self.planner(ego).view(1, 6, 2)
        return bev, self.scores(x), self.boxes(x), plan


def export(path: Path, seed: int = 0) -> None:
    """Write the graph."""
    torch.manual_seed(seed)
    feeds = draw(seed)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        torch.onnx.export(
            Head().eval(),
            tuple(torch.from_numpy(array) for array in feeds.values()),
            path,
            dynamo=False,
            opset_version=17,
            input_names=list(feeds),
            output_names=["bev", "scores", "boxes", "plan"],
        )


def record(folder: Path, count: int, seed: int) -> None:
    """Write frames, each a scene."""
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(count):
        with (folder / f"{index:06d}.npz").open("wb") as stream:
            np.savez(stream, allow_pickle=False, **draw(seed * 1000 + index))
    (folder / "scenes.json").write_text(json.dumps({"scenes": list(range(count))}))


def draw(seed: int) -> dict[str, np.ndarray[tuple[int, ...], np.dtype[np.float32]]]:
    """One frame: rectified features, cells seen at random places of each camera."""
    random = np.random.default_rng(seed)
    spread = 1 + 3 * random.random(WIDTH)
    drawn = {
        "views": np.maximum(
            random.standard_normal((CAMERAS, ROWS * COLUMNS, WIDTH)) * spread, 0
        ),
        "past": random.standard_normal((1, SIDE * SIDE, WIDTH)),
        "projected": random.random((CAMERAS, SIDE * SIDE, 2)),
        "can_bus": random.standard_normal((1, 18)),
    }
    return {name: array.astype(np.float32) for name, array in drawn.items()}
