"""The view from above of a paper figure: light, few colours, what matters on top."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from me2e_compress.simulator.camera_rig import SUBPIXEL_BITS, fixed_point
from me2e_compress.simulator.cameras.ground import RESOLUTION_M, GroundTexture
from me2e_compress.simulator.scene import (
    Actor,
    ActorKind,
    Ego,
    Event,
    PixelClass,
    Scene,
    SignalKind,
    SignalState,
)

# Antialiased drawing in metres, on a view from above with the ego's heading up.


Bytes = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float64]
Colour = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Canvas:
    """A picture uint8 [H, W, 3] and the map from the world to its pixels.

    Attributes:
        pixels: RGB, changed in place.
        centre: World point (x, y) that `anchor` shows.
        heading: World heading that points up, radians.
        scale: Pixels per metre.
        anchor: (column, row) of `centre`.
    """

    pixels: Bytes
    centre: tuple[float, float]
    heading: float
    scale: float
    anchor: tuple[float, float]

    @property
    def axes(self) -> Floats:
        """[2, 2] rows: pixels right and pixels down for metres east and north."""
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        return self.scale * np.array([(sin, -cos), (-cos, -sin)])

    def to_pixels(self, points: npt.ArrayLike) -> Floats:
        """Convert world points [..., 2] to continuous pixels (column, row)."""
        offset = np.asarray(points, float) - self.centre
        return np.asarray(offset @ self.axes.T + self.anchor)

    def polygon(self, points: npt.ArrayLike, colour: Colour) -> None:
        """Fill a polygon of world points [N, 2]."""
        fixed = [fixed_point(self.to_pixels(points))]
        cv2.fillPoly(self.pixels, fixed, colour, cv2.LINE_AA, SUBPIXEL_BITS)

    def line(
        self,
        points: npt.ArrayLike,
        colour: Colour,
        width_px: int = 1,
        *,
        closed: bool = False,
    ) -> None:
        """Draw a polyline of world points [N, 2]."""
        fixed = [fixed_point(self.to_pixels(points))]
        cv2.polylines(
            self.pixels, fixed, closed, colour, width_px, cv2.LINE_AA, SUBPIXEL_BITS
        )

    def dot(self, point: npt.ArrayLike, colour: Colour, radius_px: float) -> None:
        """Fill a disc around a world point."""
        column, row = fixed_point(self.to_pixels(point)).tolist()
        radius = round(radius_px * (1 << SUBPIXEL_BITS))
        cv2.circle(
            self.pixels, (column, row), radius, colour, -1, cv2.LINE_AA, SUBPIXEL_BITS
        )

    def box(
        self, x: float, y: float, heading: float, size: tuple[float, float]
    ) -> Floats:
        """Return [4, 2] world corners of a box: front left first, counter-clockwise."""
        forward = np.array([np.cos(heading), np.sin(heading)]) * size[0] / 2
        left = np.array([-np.sin(heading), np.cos(heading)]) * size[1] / 2
        centre = np.array([x, y])
        corners = (forward + left, left - forward, -forward - left, forward - left)
        return centre + np.array(corners)


@dataclass(frozen=True, slots=True)
class Text:
    """A piece of text with its upper left corner at (column, row)."""

    content: str
    column: float
    row: float
    size_px: int
    colour: Colour
    halo: Colour | None = None


def write(pixels: Bytes, texts: Iterable[Text]) -> None:
    """Draw texts into uint8 [H, W, 3], in the font that comes with Pillow."""
    image = Image.fromarray(pixels)
    draw = ImageDraw.Draw(image)
    for text in texts:
        draw.text(
            (text.column, text.row),
            text.content,
            fill=text.colour,
            font=ImageFont.load_default(text.size_px),
            stroke_width=0 if text.halo is None else 2,
            stroke_fill=text.halo,
        )
    pixels[:] = np.asarray(image)


def text_width(content: str, size_px: int) -> float:
    """Return the width of a text in pixels."""
    return float(ImageFont.load_default(size_px).getlength(content))


GROUND: dict[PixelClass, Colour] = {
    PixelClass.TERRAIN: (237, 240, 231),
    PixelClass.SHOULDER: (221, 219, 212),
    PixelClass.DRIVABLE: (201, 204, 209),
    PixelClass.LANE_MARKING: (255, 255, 255),
    PixelClass.STOP_LINE: (255, 255, 255),
    PixelClass.CROSSWALK: (250, 250, 250),
}
ACTORS: dict[ActorKind, Colour] = {
    ActorKind.PEDESTRIAN: (162, 52, 150),
    ActorKind.BICYCLE: (0, 134, 139),
    ActorKind.CONE: (240, 120, 32),
    ActorKind.BARRIER: (240, 120, 32),
    ActorKind.EMERGENCY: (196, 60, 60),
    ActorKind.PARKED: (146, 150, 158),
}
VEHICLE: Colour = (96, 104, 118)
EGO: Colour = (24, 92, 190)
TRAIL: Colour = (112, 158, 222)
ROUTE: Colour = (176, 196, 224)
PLAN: Colour = (226, 88, 22)
BRAKE: Colour = (220, 32, 36)
INFRACTION: Colour = (208, 16, 32)
INK: Colour = (40, 44, 52)
PAPER: Colour = (255, 255, 255)
SIGNS: Colour = (204, 24, 34)
STATES: dict[SignalState, Colour] = {
    SignalState.RED: (220, 32, 36),
    SignalState.YELLOW: (232, 172, 16),
    SignalState.GREEN: (28, 164, 84),
}
AHEAD_M, BEHIND_M = 50.0, 22.0
SCALE_BAR_M = 10.0
LABEL_PX = 14


@dataclass(frozen=True, eq=False)
class BirdsEye:
    """Draws moments of one route from above.

    ``texture`` is drawn by its class raster, in the figure's colours; ``route`` holds
    [N, 2] world points of the route's centre line.
    """

    texture: GroundTexture
    route: Floats

    def draw(
        self,
        scene: Scene,
        trail: Floats,
        plan: Floats | None,
        events: tuple[Event, ...],
        size: tuple[int, int],
    ) -> Bytes:
        """Draw one moment, uint8 [rows, columns, 3].

        ``trail`` [N, 2] holds the ego's positions, ``plan`` [n, 2] metres in the ego
        frame. The picture shows 72 m from top to bottom.
        """
        # the ego heads up
        rows, columns = size
        ego = scene.ego
        scale = rows / (AHEAD_M + BEHIND_M)
        anchor = (columns / 2, AHEAD_M * scale)
        pixels = np.empty((rows, columns, 3), np.uint8)
        canvas = Canvas(pixels, (ego.x, ego.y), ego.heading, scale, anchor)
        # layers, what matters most last
        self._ground(canvas)
        canvas.line(self.route, ROUTE, 2)
        if len(trail) > 1:
            canvas.line(trail, TRAIL, 3)
        _signals(canvas, scene)
        for actor in scene.actors:
            _actor(canvas, actor)
        _ego(canvas, ego, plan)
        _infractions(canvas, events)
        _scale_bar(canvas)
        return pixels

    @cached_property
    def _map(self) -> Bytes:
        """The class raster in the figure's colours, at half its resolution."""
        palette = np.zeros((256, 3), np.uint8)
        for kind, colour in GROUND.items():
            palette[kind] = colour
        height, width = self.texture.classes.shape
        return np.asarray(
            cv2.resize(
                palette[self.texture.classes],
                (width // 2, height // 2),
                interpolation=cv2.INTER_AREA,
            ),
            np.uint8,
        )

    def _ground(self, canvas: Canvas) -> None:
        texel = 2 * RESOLUTION_M
        inverse = np.linalg.inv(canvas.axes)  # pixels to metres east and north
        corner = inverse @ (0.5 - np.array(canvas.anchor)) + canvas.centre
        corner = corner - (self.texture.west_m, self.texture.north_m)
        flip = np.array([1.0, -1.0]) / texel
        affine = np.column_stack([inverse * flip[:, None], corner * flip - 0.5])
        rows, columns = canvas.pixels.shape[:2]
        canvas.pixels[:] = cv2.warpAffine(
            self._map,
            affine,
            (columns, rows),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )


def _ego(canvas: Canvas, ego: Ego, plan: Floats | None) -> None:
    corners = canvas.box(ego.x, ego.y, ego.heading, (ego.length, ego.width))
    _vehicle(canvas, corners, EGO)
    if plan is None:
        return
    points = np.concatenate([[(ego.x, ego.y)], ego.placed(plan)])
    canvas.line(points, PLAN, 2)
    for point in points[1:]:
        canvas.dot(point, PAPER, 4.0)
        canvas.dot(point, PLAN, 3.0)


def _vehicle(canvas: Canvas, corners: Floats, colour: Colour) -> None:
    """Draw a box with a lighter windscreen that shows its heading."""
    canvas.polygon(corners, colour)
    front_left, rear_left, rear_right, front_right = corners
    edges = (front_left, front_right, front_right, front_left)
    rears = (rear_left, rear_right, rear_right, rear_left)
    screen = [
        edge + part * (rear - edge)
        for edge, rear, part in zip(edges, rears, (0.2, 0.2, 0.38, 0.38), strict=True)
    ]
    shade: Colour = (198, 212, 230)
    middle = np.mean(screen, axis=0)
    canvas.polygon(middle + (np.array(screen) - middle) * 0.8, shade)


def _actor(canvas: Canvas, actor: Actor) -> None:
    colour = ACTORS.get(actor.kind, VEHICLE)
    if actor.kind is ActorKind.PEDESTRIAN:
        canvas.dot((actor.x, actor.y), PAPER, 5.0)
        canvas.dot((actor.x, actor.y), colour, 3.5)
        return
    size = (actor.length, actor.width)
    corners = canvas.box(actor.x, actor.y, actor.heading, size)
    if actor.length < 2.5:
        canvas.polygon(corners, colour)
        canvas.line(corners, colour, 1, closed=True)
        return
    _vehicle(canvas, corners, colour)
    if actor.braking:
        canvas.line(corners[1:3], BRAKE, 3)


def _signals(canvas: Canvas, scene: Scene) -> None:
    for signal in scene.signals:
        colour = SIGNS if signal.state is None else STATES[signal.state]
        canvas.line(signal.stop_line, colour, 3)
        place = (signal.x, signal.y)
        canvas.dot(place, PAPER, 7.0)
        if signal.kind is SignalKind.TRAFFIC_LIGHT:
            canvas.dot(place, colour, 5.0)
            continue
        sides = 8 if signal.kind is SignalKind.STOP_SIGN else 3
        turn = signal.heading + np.pi + (np.pi / 8 if sides == 8 else 0.0)
        angle = turn + 2 * np.pi * np.arange(sides) / sides
        ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) * 6.0 / canvas.scale
        canvas.polygon(ring + place, colour)


def _infractions(canvas: Canvas, events: tuple[Event, ...]) -> None:
    """Draw a cross and a name where the ego was; one per kind and place."""
    rows, columns = canvas.pixels.shape[:2]
    arm, texts = 7.0 / canvas.scale, list[Text]()
    for event in events:
        column, row = canvas.to_pixels((event.x, event.y)).tolist()
        name = event.kind.replace("_", " ")
        left = min(column + 12, columns - text_width(name, LABEL_PX) - 4)
        near = [t for t in texts if np.hypot(t.column - left, t.row - row) < 40]
        inside = 0 <= column < columns and 0 <= row < rows
        if not inside or name in (text.content for text in near):
            continue
        place = np.array([event.x, event.y])
        for colour, width in ((PAPER, 7), (INFRACTION, 3)):
            for slant in (1.0, -1.0):
                offset = np.array([arm, slant * arm])
                canvas.line((place - offset, place + offset), colour, width)
        top = row - LABEL_PX / 2 + (LABEL_PX + 2) * len(near)
        texts.append(Text(name, left, top, LABEL_PX, INFRACTION, PAPER))
    write(canvas.pixels, texts)


def _scale_bar(canvas: Canvas) -> None:
    rows = canvas.pixels.shape[0]
    length = round(SCALE_BAR_M * canvas.scale)
    cv2.line(canvas.pixels, (10, rows - 12), (10 + length, rows - 12), INK, 2)
    label = Text(f"{SCALE_BAR_M:g} m", 12, rows - 30, 13, INK, PAPER)
    write(canvas.pixels, [label])
