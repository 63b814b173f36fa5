"""Pictures of a driven route: six cameras and the view from above, as PNG and GIF."""

import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from me2e_compress.base.atomic import write_bytes, writing_errors
from me2e_compress.base.errors import EvaluationError
from me2e_compress.simulator.camera_rig import CAMERA_NAMES
from me2e_compress.simulator.cameras.ground import (
    RESOLUTION_M,
    Bytes,
    Colour,
    GroundTexture,
)
from me2e_compress.simulator.plane_geometry import Floats, corners
from me2e_compress.simulator.scene import (
    INFRACTIONS,
    Actor,
    ActorKind,
    Ego,
    Event,
    PixelClass,
    Scene,
    Signal,
    SignalKind,
    SignalState,
    box_of,
)

# As in nuScenes' figures. Rear images are not mirrored: in BACK, what is to the left of
# the car is to the right of the image.
MONTAGE = (("FRONT_LEFT", "FRONT", "FRONT_RIGHT"), ("BACK_LEFT", "BACK", "BACK_RIGHT"))
TILE, GAP, CAPTION = 320, 4, 30  # pixels of a camera, between pictures, of text
COLOURS = 256  # colours of an animation's palette
FINE = 2  # the view from above is drawn so much larger, then reduced: smooth edges
AHEAD_M, BEHIND_M = 50.0, 22.0
# the colours of a paper figure: light, few
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
SCREEN: Colour = (198, 212, 230)
EGO: Colour = (24, 92, 190)
TRAIL: Colour = (112, 158, 222)
ROUTE: Colour = (176, 196, 224)
PLAN: Colour = (226, 88, 22)
BRAKE: Colour = (220, 32, 36)
INFRACTION: Colour = (208, 16, 32)
INK: Colour = (40, 44, 52)
PAPER: Colour = (255, 255, 255)
SCALE_BAR_M = 10.0
STATES: dict[SignalState, Colour] = {
    SignalState.RED: (220, 32, 36),
    SignalState.YELLOW: (232, 172, 16),
    SignalState.GREEN: (28, 164, 84),
}


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """The record of one frame."""

    scene: Scene
    images: Bytes  # (6, rows, columns, 3) RGB
    # Waypoints in force, (n, 2) metres in the ego frame; None before the first plan and
    # for a policy that answers controls
    plan: Floats | None = None
    events: tuple[Event, ...] = ()  # since the moment before, or since earlier


@dataclass(frozen=True, eq=False)
class RoutePicture:
    """Draws a route from its recorded moments."""

    title: str  # first words of the caption: the scenario, the route, the driver
    texture: GroundTexture
    route: Floats  # (n, 2) world points
    moments: Sequence[Moment]  # at least one, in order of time

    def __post_init__(self) -> None:
        if not self.moments:
            raise EvaluationError(f"{self.title}: no moments to draw")

    def frame(self, index: int) -> Image.Image:
        """Draw the six cameras, the view from above and a caption."""
        tiles = [[self.tile(index, name) for name in names] for names in MONTAGE]
        wide, tall = (side + GAP for side in tiles[0][0].size)
        above = self._from_above(index, (round(0.82 * 2 * tall), 2 * tall - GAP))
        size = 3 * wide + above.width, 2 * tall + CAPTION
        picture = Image.new("RGB", size, PAPER)
        for row, column in np.ndindex(2, 3):
            picture.paste(tiles[row][column], (column * wide, row * tall))
        picture.paste(above, (3 * wide, 0))
        # title, time and speed, and the infractions so far in red
        caption = f"{self.title}   {_state(self.moments[index])}"
        left = write(picture, (6, 2 * tall + 7), caption, INK, 15)
        kinds = dict.fromkeys(event.kind for event in self.infractions(index))
        names = ", ".join(kinds).replace("_", " ")
        write(picture, (left + 16, 2 * tall + 7), names, INFRACTION, 15)
        return picture

    def frames(self) -> Iterable[Image.Image]:
        """Yield all moments."""
        return map(self.frame, range(len(self.moments)))

    def strip(self, indices: Sequence[int]) -> Image.Image:
        """Draw moments side by side, the front camera above the view from above."""
        side, tiles = TILE, [self.tile(i, "FRONT") for i in indices]
        below = CAPTION + GAP + tiles[0].height + GAP
        size = len(tiles) * (side + GAP) - GAP, below + side
        picture = Image.new("RGB", size, PAPER)
        for column, (index, tile) in enumerate(zip(indices, tiles, strict=True)):
            left = column * (side + GAP)
            write(picture, (left + 4, 7), _state(self.moments[index]), INK, 14)
            picture.paste(tile, (left, CAPTION + GAP))
            picture.paste(self._from_above(index, (side, side)), (left, below))
        return picture

    def tile(self, index: int, name: str) -> Image.Image:
        """Draw one camera's image, with its name."""
        image = self.moments[index].images[CAMERA_NAMES.index(name)]
        height = round(TILE * image.shape[0] / image.shape[1])
        size, how = (TILE, height), Image.Resampling.BILINEAR
        tile = Image.fromarray(image).resize(size, how)
        write(tile, (5, 3), name, PAPER, 12, INK)
        return tile

    def infractions(self, index: int) -> tuple[Event, ...]:
        """Return the infractions up to a moment, each once, in order."""
        events = (e for moment in self.moments[: index + 1] for e in moment.events)
        return tuple(dict.fromkeys(e for e in events if e.kind in INFRACTIONS))

    @cached_property
    def _map(self) -> Image.Image:
        """The class raster in the figure's colours, at half its resolution."""
        palette = np.zeros((256, 3), np.uint8)
        for kind, colour in GROUND.items():
            palette[kind] = colour
        return Image.fromarray(palette[self.texture.classes]).reduce(2)

    def _from_above(self, index: int, size: tuple[int, int]) -> Image.Image:
        """Draw 72 m from top to bottom, the ego heading up; ``size`` is (w, h)."""
        moment, ego = self.moments[index], self.moments[index].scene.ego
        corner = self.texture.west_m, self.texture.north_m
        view = View(self._map, corner, ego, size)
        # Draw layer by layer, what matters most last
        view.line(self.route, ROUTE, 2)
        driven = (past.scene.ego for past in self.moments[: index + 1])
        view.line([(past.x, past.y) for past in driven], TRAIL, 3)
        for signal in moment.scene.signals:
            view.signal(signal)
        for actor in moment.scene.actors:
            view.actor(actor)
        view.vehicle(ego, EGO)
        if moment.plan is not None:
            waypoints = ego.placed(moment.plan)
            view.line(np.vstack([[(ego.x, ego.y)], waypoints]), PLAN, 2)
            for point in waypoints:
                view.disc(point, PLAN, 3.0)
        for event in self.infractions(index):
            view.cross(event)
        # A bar of ten metres in the corner
        reduced = view.picture.reduce(FINE)
        bottom, length = reduced.height - 12, round(SCALE_BAR_M * view.scale / FINE)
        ImageDraw.Draw(reduced).line((10, bottom, 10 + length, bottom), INK, 2)
        write(reduced, (12, bottom - 18), f"{SCALE_BAR_M:g} m", INK, 13, PAPER)
        return reduced


class View:
    """A picture from above whose ego heads up; what is drawn is in world metres.

    It begins with the ground, a picture of two texels a pixel whose upper left corner
    is at a place of the world. Widths are those of the reduced picture.
    """

    def __init__(
        self,
        ground: Image.Image,
        corner: tuple[float, float],
        ego: Ego,
        size: tuple[int, int],
    ) -> None:
        width, height = size[0] * FINE, size[1] * FINE
        self.ego, self.scale = ego, height / (AHEAD_M + BEHIND_M)
        self.anchor = width / 2, AHEAD_M * self.scale
        # pixels right and pixels down for metres east and north
        cos, sin = math.cos(ego.heading), math.sin(ego.heading)
        self.axes = self.scale * np.array([(sin, -cos), (-cos, -sin)])
        # from pixels to metres east and south of the corner, then to texels
        back = np.linalg.inv(self.axes)
        begin = np.subtract((ego.x, ego.y), corner) - back @ self.anchor
        turn = np.column_stack([back, begin]) / (2 * RESOLUTION_M)
        turn[1] *= -1.0
        self.picture = ground.transform(
            (width, height),
            Image.Transform.AFFINE,
            turn.ravel().tolist(),
            Image.Resampling.BILINEAR,
            fillcolor=GROUND[PixelClass.TERRAIN],
        )
        self.drawing = ImageDraw.Draw(self.picture)

    def to_pixels(self, points: npt.ArrayLike) -> Floats:
        """Convert world points [..., 2] to pixels (column, row)."""
        offset = np.asarray(points, float) - (self.ego.x, self.ego.y)
        return np.asarray(offset @ self.axes.T + self.anchor)

    def line(self, points: npt.ArrayLike, colour: Colour, width_px: int) -> None:
        """Draw a polyline of world points [N, 2]."""
        pixels = self.to_pixels(points).ravel().tolist()
        self.drawing.line(pixels, colour, width_px * FINE, joint="curve")

    def polygon(self, points: Floats, colour: Colour) -> None:
        """Fill a polygon of world points [N, 2]."""
        self.drawing.polygon(self.to_pixels(points).ravel().tolist(), colour)

    def disc(self, point: npt.ArrayLike, colour: Colour, radius_px: float) -> None:
        """Fill a disc with a white rim around a world point."""
        centre = self.to_pixels(point).tolist()
        self.drawing.circle(centre, (radius_px + 1.0) * FINE, PAPER)
        self.drawing.circle(centre, radius_px * FINE, colour)

    def vehicle(self, body: Actor | Ego, colour: Colour) -> None:
        """Draw a box with a lighter windscreen that shows its heading."""
        box = corners(np.array(box_of(body)))
        self.polygon(box, colour)
        front_left, front_right, rear_right, rear_left = box
        left, right = rear_left - front_left, rear_right - front_right
        screen = [front_left + 0.22 * left, front_right + 0.22 * right]
        screen += [front_right + 0.36 * right, front_left + 0.36 * left]
        middle = np.mean(screen, axis=0)
        self.polygon(middle + (np.array(screen) - middle) * 0.8, SCREEN)

    def actor(self, actor: Actor) -> None:
        """Draw a road user or an obstacle; brake lights are a red edge."""
        colour = ACTORS.get(actor.kind, VEHICLE)
        if actor.kind is ActorKind.PEDESTRIAN:
            self.disc((actor.x, actor.y), colour, 3.5)
        elif actor.length < 2.5:
            self.polygon(corners(np.array(box_of(actor))), colour)
        else:
            self.vehicle(actor, colour)
            if actor.braking:
                self.line(corners(np.array(box_of(actor)))[2:], BRAKE, 3)

    def signal(self, signal: Signal) -> None:
        """Draw a stop line and, beside it, a lamp, an octagon or a triangle."""
        colour = BRAKE if signal.state is None else STATES[signal.state]
        self.line(signal.stop_line, colour, 3)
        self.disc((signal.x, signal.y), PAPER, 6.0)
        if signal.kind is SignalKind.TRAFFIC_LIGHT:
            self.disc((signal.x, signal.y), colour, 5.0)
            return
        sides = 8 if signal.kind is SignalKind.STOP_SIGN else 3
        centre = self.to_pixels((signal.x, signal.y)).tolist()
        turned = 180 if sides == 3 else 0  # a give-way sign stands on its point
        self.drawing.regular_polygon((centre, 6.0 * FINE), sides, turned, colour)

    def cross(self, event: Event) -> None:
        """Draw a red cross where the ego was."""
        x, y = self.to_pixels((event.x, event.y)).tolist()
        arm = 7.0 * FINE
        for colour, width in ((PAPER, 7), (INFRACTION, 3)):
            for slant in (arm, -arm):
                ends = (x - arm, y - slant, x + arm, y + slant)
                self.drawing.line(ends, colour, width * FINE)


def write(
    picture: Image.Image,
    place: tuple[float, float],
    text: str,
    colour: Colour,
    size_px: int,
    halo: Colour | None = None,
) -> float:
    """Draw a text, its upper left corner at (column, row); return where it ends."""
    font, stroke = ImageFont.load_default(size_px), 0 if halo is None else 2
    ImageDraw.Draw(picture).text(
        place, text, colour, font, stroke_width=stroke, stroke_fill=halo
    )
    return place[0] + float(font.getlength(text))


def _state(moment: Moment) -> str:
    scene = moment.scene
    return f"t = {scene.time_us / 1e6:.2f} s   {scene.ego.speed_mps:.1f} m/s"


def write_picture(
    path: Path, pictures: Iterable[Image.Image], frame_us: int = 0
) -> None:
    """Write one picture as PNG, or, by the name, several as a GIF that loops.

    Raises:
        EvaluationError: The file cannot be written.
    """
    content, images = io.BytesIO(), list(pictures)
    if path.suffix == ".png":
        images[0].save(content, "PNG")
    else:
        # the 256 colours of a few frames from the whole animation
        chosen = images[:: max(1, len(images) // 6)]
        sheet = Image.fromarray(np.concatenate([np.asarray(image) for image in chosen]))
        palette, none = sheet.quantize(COLOURS), Image.Dither.NONE
        first, *others = (e.quantize(palette=palette, dither=none) for e in images)
        # in milliseconds, but GIF counts hundredths of a second
        duration = max(20, round(frame_us / 10_000) * 10)
        first.save(
            content,
            "GIF",
            save_all=True,
            append_images=others,
            duration=duration,
            loop=0,
            optimize=False,
        )
    with writing_errors(path, EvaluationError):
        write_bytes(path, content.getvalue())
