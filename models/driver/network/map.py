"""The road: routes for every command, the ground, signals."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from models.driver.network.bev_grid import grid_of, route_points
from models.driver.network.blocks import DecoderLayer, conv_block, mlp, sample
from models.driver.network.config import (
    CAMERAS,
    COMMANDS,
    RASTER_CHANNELS,
    SIGNAL_KINDS,
    SIGNAL_STATES,
    HighwayConfig,
)

FORWARD_CAMERAS = 3
"""The first three cameras look ahead, and to both sides of it."""
BEND = 0.1
"""Scale of curvatures, 1/m: a junction is turned on a radius of about 10 m."""
WIDTH_SCALE_M = 4.0
"""Offsets and widths are predicted in units of a wide lane."""
SPEED_SCALE_MPS = 10.0
"""Speeds are predicted in these units, about 1 in size."""
GAP_SCALE_M = 10.0
"""Distances to stop lines are predicted in these units: the last 10 m matter."""


@dataclass
class RoadMap:
    """Outputs of the map module.

    Attributes:
        query: [B, 6 * P, C] a token for every point of every route.
        lateral: [B, 6] metres that the ego is left of the route of each command.
        headings: [B, 6, P] radians, of the routes in the ego frame.
        paths: [B, 6, P, 2] metres.
        attributes: [B, 6, P, 4] metres of road to the left, to the right and to the
            left with oncoming lanes; speed at which this point can be passed (m/s).
        raster: [B, 4, 2 * rows, 2 * columns] logits of the ground.
        signal_query: [B, 3, C].
        signals: [B, 3, 5] logit that it is there, metres to its line over 10, logits
            of red, yellow, green.
        rough: [B, 6, P, 2] the routes before they are refined.
    """

    query: Tensor
    lateral: Tensor
    headings: Tensor
    paths: Tensor
    attributes: Tensor
    raster: Tensor
    signal_query: Tensor
    signals: Tensor
    rough: Tensor


@dataclass
class MapRoute:
    """What the command picks from the map.

    Attributes:
        lateral: [B] metres that the ego is left of it.
        path: [B, P, 2] metres in the ego frame.
        headings: [B, P] radians.
        attributes: [B, P, 4], see `RoadMap`.
        points: [B, P, C] its queries.
    """

    lateral: Tensor
    path: Tensor
    headings: Tensor
    attributes: Tensor
    points: Tensor


class Choice(nn.Module):
    """The route of the command, as a module: exported nodes have its scope."""

    def forward(self, road: RoadMap, command: Tensor) -> MapRoute:
        """Pick the routes of int64 [B] commands."""
        return route_of(road, command)


def route_of(road: RoadMap, command: Tensor) -> MapRoute:
    """Return the route of each command, int64 [B]."""

    def picked(values: Tensor) -> Tensor:
        where = command.view(-1, *(1 for _ in values.shape[1:]))
        return values.gather(1, where.expand(-1, 1, *values.shape[2:])).squeeze(1)

    return MapRoute(
        picked(road.lateral),
        picked(road.paths),
        picked(road.headings),
        picked(road.attributes),
        picked(road.query.unflatten(1, (COMMANDS, -1))),
    )


class Map(nn.Module):
    """Queries for the points of six routes, a raster, three signal queries."""

    def __init__(self, config: HighwayConfig) -> None:
        super().__init__()
        channels, heads = config.channels, config.heads
        self.area, self.points = config.area, config.path_points
        self.commands = nn.Parameter(torch.randn(COMMANDS, 1, channels) * 0.5)
        self.stations = nn.Parameter(torch.randn(1, self.points, channels) * 0.5)
        self.first = DecoderLayer(channels, heads)
        self.second = DecoderLayer(channels, heads)
        self.rough, self.fine = mlp(channels, channels, 2), mlp(channels, channels, 2)
        self.look = nn.Linear(channels, channels)
        self.attributes = mlp(channels, channels, 4)
        self.raster = nn.Sequential(
            conv_block(channels, channels // 2),
            nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False),
            conv_block(channels // 2, channels // 2),
            nn.Conv2d(channels // 2, RASTER_CHANNELS, 1),
        )
        rows, columns = (side // 8 for side in config.image_size)
        tokens = FORWARD_CAMERAS * rows * columns
        self.pixels = nn.Parameter(torch.randn(1, tokens, channels) * 0.1)
        self.kinds = nn.Parameter(torch.randn(1, SIGNAL_KINDS, channels) * 0.5)
        self.signal_image = DecoderLayer(channels, heads)
        self.signal_bev = DecoderLayer(channels, heads)
        self.signal = mlp(channels, channels, 2 + SIGNAL_STATES)

    def forward(self, bev: Tensor, tokens: Tensor, images: Tensor) -> RoadMap:
        """Read the road.

        Args:
            bev: [B, C, rows, columns].
            tokens: [B, N, C], the same with the place of each cell.
            images: [B * 6, C, h, w], stride 8.
        """
        batch = bev.shape[0]
        query = (self.commands + self.stations).flatten(0, 1)
        query = self.first(query.expand(batch, -1, -1), tokens, tokens)
        lateral, bends = self._bends(self.rough(query))
        rough = route_points(lateral, bends.cumsum(-1))
        query = query + self.look(self._at(bev, rough.detach()))
        query = self.second(query, tokens, tokens)
        more, bend_more = self._bends(self.fine(query))
        lateral, headings = lateral + more, (bends + bend_more).cumsum(-1)
        scale = self.attributes(query).float().unflatten(1, (COMMANDS, -1))
        signals, signal_query = self._signals(tokens, images, batch)
        return RoadMap(
            query,
            lateral,
            headings,
            route_points(lateral, headings),
            torch.cat(
                [scale[..., :3] * WIDTH_SCALE_M, scale[..., 3:] * SPEED_SCALE_MPS], -1
            ),
            self.raster(bev).float(),
            signal_query,
            signals,
            rough,
        )

    def _bends(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        """Split [B, 6 P, 2] into offsets [B, 6] and turns between points [B, 6, P]."""
        raw = raw.float().unflatten(1, (COMMANDS, self.points))
        return raw[:, :, 0, 1] * WIDTH_SCALE_M, raw[..., 0] * (2 * BEND)

    def _at(self, bev: Tensor, paths: Tensor) -> Tensor:
        """Return features [B, 6 P, C] at points [B, 6, P, 2]."""
        found = sample(bev, grid_of(paths, self.area))
        return found.flatten(2).transpose(1, 2)

    def _signals(
        self, tokens: Tensor, images: Tensor, batch: int
    ) -> tuple[Tensor, Tensor]:
        ahead = images.unflatten(0, (batch, CAMERAS))[:, :FORWARD_CAMERAS]
        pixels = ahead.permute(0, 1, 3, 4, 2).flatten(1, 3) + self.pixels
        query = self.kinds.expand(batch, -1, -1)
        query = self.signal_image(query, pixels, pixels)
        query = self.signal_bev(query, tokens, tokens)
        return self.signal(query).float(), query
