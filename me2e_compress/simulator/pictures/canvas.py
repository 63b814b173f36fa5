"""Antialiased drawing in metres, on a view from above with the ego's heading up."""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from me2e_compress.simulator.camera_rig import SUBPIXEL_BITS, fixed_point

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
