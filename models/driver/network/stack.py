"""The whole stack: backbone, neck and occupancy head, and all modules in order."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from models.driver.network.bev_encoder import BevEncoder
from models.driver.network.blocks import Residual, conv_block
from models.driver.network.config import STEPS, HighwayConfig
from models.driver.network.interfaces import EgoState, PlannerInput
from models.driver.network.map import Choice, Map, RoadMap
from models.driver.network.motion import Futures, Motion
from models.driver.network.planner import Planner
from models.driver.network.track import Track, Tracks
from models.export import save, trace
from models.stacks import HIGHWAY


class Backbone(nn.Module):
    """A small residual network."""

    def __init__(self, config: HighwayConfig) -> None:
        super().__init__()
        first, second, third, fourth = config.stages
        self.stem = conv_block(3, first, 3, 2)
        self.stage1 = Residual(first, second, 2)
        self.stage2 = nn.Sequential(Residual(second, third, 2), Residual(third, third))
        self.stage3 = nn.Sequential(
            Residual(third, fourth, 2), Residual(fourth, fourth)
        )

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Map [B, 3, H, W] to features of strides 4, 8 and 16."""
        fine = self.stage1(self.stem(images))
        middle = self.stage2(fine)
        return fine, middle, self.stage3(middle)


class Neck(nn.Module):
    """Combines the strides (Lin et al., 2017, without the smoothing)."""

    def __init__(self, config: HighwayConfig) -> None:
        super().__init__()
        _, *widths = config.stages
        self.laterals = nn.ModuleList(
            [nn.Conv2d(width, config.channels, 1) for width in widths]
        )
        self.grow = nn.Upsample(scale_factor=2, mode="nearest")

    def forward(self, features: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """Map features to [B, C, H / 4, W / 4] and [B, C, H / 8, W / 8]."""
        fine, middle, coarse = (
            lateral(x) for lateral, x in zip(self.laterals, features, strict=True)
        )
        middle = middle + self.grow(coarse)
        return fine + self.grow(middle), middle


class Occ(nn.Module):
    """Occupancy 0.5 to 3 s from now; not of now, which the boxes give."""

    def __init__(self, config: HighwayConfig) -> None:
        super().__init__()
        channels = config.channels
        self.body = nn.Sequential(
            Residual(channels, channels),
            conv_block(channels, channels // 2, 1),
            nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False),
            conv_block(channels // 2, channels // 2),
            nn.Conv2d(channels // 2, STEPS, 1),
        )

    def forward(self, bev: Tensor) -> Tensor:
        """Map [B, C, rows, columns] to logits [B, 6, 2 * rows, 2 * columns]."""
        taken: Tensor = self.body(bev).float()
        return taken


STANDING_MPS = 0.1
STOOD_S = 5.0
"""Time constant with which the memory of standing decays."""


@dataclass
class ModuleOutputs:
    """Outputs of all modules for one frame.

    Attributes:
        tracks: of the track module.
        road: of the map module.
        futures: of the motion module.
        occupancy: [B, 6, 2 * rows, 2 * columns] logits of the occ module.
    """

    tracks: Tracks
    road: RoadMap
    futures: Futures
    occupancy: Tensor


class Highway(nn.Module):
    """Six cameras to a plan."""

    def __init__(self, config: HighwayConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or HighwayConfig()
        self.backbone, self.neck = Backbone(config), Neck(config)
        self.bev_encoder = BevEncoder(config)
        self.track, self.map = Track(config), Map(config)
        self.motion, self.occ = Motion(config), Occ(config)
        self.planner = Planner(config)
        # no weights: their names tell which module a part of the world belongs to
        self.map_route, self.map_raster = Choice(), nn.Sigmoid()
        self.motion_modes, self.occ_taken = nn.Softmax(-1), nn.Sigmoid()

    def look(self, img: Tensor) -> tuple[Tensor, Tensor]:
        """Map images [B, 6, 3, H, W] to features [B * 6, C, h, w], strides 4 and 8."""
        fine, middle = self.neck(self.backbone(img.flatten(0, 1)))
        return fine, middle

    def understand(
        self, bev: Tensor, tokens: Tensor, images: Tensor, hints: Tensor | None = None
    ) -> ModuleOutputs:
        """Run the task modules.

        Args:
            bev: [B, C, rows, columns].
            tokens: [B, N, C].
            images: [B * 6, C, h, w], stride 8.
            hints: see `Track`.
        """
        tracks = self.track(bev, tokens, hints)
        road = self.map(bev, tokens, images)
        return ModuleOutputs(tracks, road, self.motion(tracks, road), self.occ(bev))

    def world(self, seen: ModuleOutputs, command: Tensor) -> PlannerInput:
        """Gather what the planner reads; the command, int64 [B], picks the route.

        Every part is made in a scope of the exported graph that begins with the name
        of its module, so that ablating a module removes all of it, outputs too.
        """
        tracks, road, futures = seen.tracks, seen.road, seen.futures
        # the order in which the exporter traces them: that of the nodes in the file
        route = self.map_route(road, command)
        raster = self.map_raster(road.raster)
        modes = self.motion_modes(futures.logits)
        occupancy = self.occ_taken(seen.occupancy)
        return PlannerInput(
            agents=futures.query,
            boxes=tracks.boxes,
            score=tracks.score,
            travel=futures.travel,
            modes=modes,
            lateral=route.lateral,
            path=route.path,
            headings=route.headings,
            attributes=route.attributes,
            points=route.points,
            raster=raster,
            signal_query=road.signal_query,
            signals=road.signals,
            occupancy=occupancy,
        )

    def forward(
        self,
        img: Tensor,
        lidar2img: Tensor,
        can_bus: Tensor,
        command: Tensor,
        timestamp: Tensor,
        prev_bev: Tensor,
        prev_memory: Tensor,
    ) -> tuple[Tensor, ...]:
        """Compute one decision, as it is exported.

        Args:
            img: [1, 6, 3, H, W], normalised.
            lidar2img: [1, 6, 4, 4].
            can_bus: [18], see the policy contract.
            command: int64 [1].
            timestamp: [1] seconds since the route began.
            prev_bev: [1, N, C + 2], zeros at the start.
            prev_memory: [1, 2] when it last looked (s), how lately it stood (1 now,
                0 never); zeros at the start.

        Returns:
            plan [1, 6, 2], boxes [1, A, 8], scores [1, A], futures [1, A, M, 6, 2],
            route [1, P, 2], occupancy [1, 6, 64, 48] (probabilities), prev_bev_out,
            prev_memory_out.
        """
        bus, elapsed = can_bus[None], timestamp - prev_memory[:, 0]
        fine, middle = self.look(img)
        bev, tokens, kept = self.bev_encoder(fine, lidar2img, bus, elapsed, prev_bev)
        seen = self.understand(bev, tokens, middle)
        ego = EgoState(bus, stood_lately(bus[:, 7], prev_memory[:, 1], elapsed))
        world = self.world(seen, command)
        plan = self.planner(world, ego, command)
        memory = torch.stack([timestamp, ego.stood], -1)
        return (
            plan,
            world.boxes,
            world.score,
            world.travel,
            world.path,
            world.occupancy,
            kept,
            memory,
        )


def stood_lately(speed: Tensor, before: Tensor, elapsed_s: Tensor) -> Tensor:
    """Return [B], 1 while the ego stands, then decaying with `STOOD_S`."""
    faded = before * torch.exp(-elapsed_s / STOOD_S)
    standing = (speed.abs() < STANDING_MPS).to(speed.dtype)
    return torch.maximum(faded, standing)


OPSET = 17
"""LayerNormalization is one operator from here on."""


def write_onnx(model: Highway, path: Path) -> Path:
    """Write a model in evaluation mode, standard operators only, nothing folded.

    Args:
        model: the stack, its weights as they are to drive.
        path: the ``.onnx``; replaced in one step.

    Raises:
        GraphError: the exporter wrote another opset, or it cannot be written.
    """
    # torch's stubs leave this form of `to` out
    model.eval().to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    return save(trace(HIGHWAY, model, OPSET), HIGHWAY.metadata(), path)
