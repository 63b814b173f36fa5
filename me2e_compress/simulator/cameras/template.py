"""Shapes that the painter knows: lists of quadrilaterals in painting order.

A template lives in a unit box that is scaled to the solid: x from -0.5 (rear) to 0.5
(front), y from -0.5 (right) to 0.5 (left), z from 0 (ground) to 1 (top). Quadrilaterals
wind counter-clockwise seen from outside, so that back faces are not drawn.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.plane_geometry import Floats

Span = tuple[float, float]  # two ends, or two coordinates
FULL = (-0.5, 0.5)  # the whole unit box
# A sun from the upper left; faces differ enough to be told apart
SHADES = {"top": 1.08, "front": 0.90, "back": 0.78, "left": 0.96, "right": 0.70}


class Slot(IntEnum):
    """Which of a solid's colours a quadrilateral has."""

    SHADOW = 0
    BODY = 1
    TRIM = 2
    GLASS = 3
    TYRE = 4
    SKIN = 5
    LEGS = 6
    STRIPE = 7
    HEADLAMP = 8  # from here on: lamps, which shine by themselves
    TAIL_LAMP = 9
    THIRD_LAMP = 10
    INDICATOR_LEFT = 11
    INDICATOR_RIGHT = 12
    BEACON = 13
    LAMP_RED = 14
    LAMP_YELLOW = 15
    LAMP_GREEN = 16


FIRST_LAMP = Slot.HEADLAMP


class Quad(NamedTuple):
    """One face: corners [4, 3], its colour and its shading."""

    corners: Floats
    slot: Slot
    shade: float
    detail: bool  # lies on another face: not needed from afar, nor for the class raster


@dataclass(frozen=True, eq=False)
class Template:
    """A convex solid, or a stack of convex solids, lowest first, in the unit box."""

    corners: Floats  # (3, 4, faces): x, y, z of the four corners of each face
    slots: npt.NDArray[np.intp]  # (faces,) values of `Slot`
    shades: Floats  # (faces,) brightness of the colour, by the direction of the face
    details: npt.NDArray[np.bool_]  # (faces,) whether it lies on another face
    footprint: Floats  # (2, 4): its rectangle on the ground, counter-clockwise


class Box:
    """A box whose upper side may be smaller (a cabin, a cone): five faces.

    The ranges are (rear, front) for ``x`` and ``top_x``, (right, left) for ``y`` and
    ``top_y``, (bottom, top) for ``z``.
    """

    def __init__(
        self,
        x: Span,
        y: Span,
        z: Span,
        slot: Slot,
        top_x: Span | None = None,
        top_y: Span | None = None,
    ) -> None:
        # corners of the foot and of the top: right and left of the rear and the front
        a, b, c, d = _rectangle(x, y, z[0])
        e, f, g, h = _rectangle(top_x or x, top_y or y, z[1])
        # faces counter-clockwise, seen from outside
        self.slot = slot
        self.faces: dict[str, Floats] = {
            "right": np.array([a, b, f, e]),
            "front": np.array([b, c, g, f]),
            "left": np.array([c, d, h, g]),
            "back": np.array([d, a, e, h]),
            "top": np.array([e, f, g, h]),
        }

    def quads(self, decals: Iterable[Quad] = ()) -> list[Quad]:
        """Return the faces and, after them, what lies on them."""
        faces = [
            Quad(corners, self.slot, SHADES[name], False)
            for name, corners in self.faces.items()
        ]
        return [*faces, *decals]

    def on(self, face: str, u: Span, v: Span, slot: Slot) -> Quad:
        """Return a patch of a face.

        ``u`` runs along the face's lower edge, counter-clockwise seen from above, and
        ``v`` upwards, both from 0 to 1.
        """
        corners = [(u[0], v[0]), (u[1], v[0]), (u[1], v[1]), (u[0], v[1])]
        return self._patch(face, corners, slot)

    def disc(self, face: str, centre: Span, radii: Span, slot: Slot) -> list[Quad]:
        """Return an octagon on a face, as three quadrilaterals; see `on` for (u, v)."""
        u, v = centre
        return [
            self._patch(face, [(u + x, v + y) for x, y in band], slot)
            for band in octagon(*radii)
        ]

    def _patch(self, face: str, corners: Sequence[Span], slot: Slot) -> Quad:
        a, b, c, d = self.faces[face]
        points = [  # bilinear between the corners of the face
            (1 - s) * ((1 - t) * a + t * d) + s * ((1 - t) * b + t * c)
            for s, t in corners
        ]
        shade = 1.0 if slot >= FIRST_LAMP else SHADES[face]
        return Quad(np.array(points), slot, shade, True)


def octagon(half_width: float, half_height: float) -> list[list[Span]]:
    """Return three quadrilaterals that make an octagon around the origin."""
    narrow, low = 0.4142 * half_width, 0.4142 * half_height  # tan 22.5 degrees
    bands = (  # lower edge, half its width; upper edge, half its width
        (-half_height, narrow, -low, half_width),
        (-low, half_width, low, half_width),
        (low, half_width, half_height, narrow),
    )
    return [[(-a, p), (a, p), (b, q), (-b, q)] for p, a, q, b in bands]


def shadow(x: Span, y: Span) -> Quad:
    """Return the contact shadow on the ground."""
    return Quad(_rectangle(x, y, 0.0), Slot.SHADOW, 1.0, True)


def _rectangle(x: Span, y: Span, z: float) -> Floats:
    """Return [4, 3] corners at one height, counter-clockwise from above."""
    return np.array(
        [(x[0], y[0], z), (x[1], y[0], z), (x[1], y[1], z), (x[0], y[1], z)]
    )


def plate(corners: Iterable[tuple[float, float, float]], slot: Slot) -> list[Quad]:
    """Return a flat quadrilateral that is seen from both sides."""
    face = np.array(list(corners))
    return [Quad(face, slot, 0.95, False), Quad(face[::-1], slot, 0.85, False)]


def sign_face(
    corners: Iterable[Span], x: float, slot: Slot, *, detail: bool
) -> list[Quad]:
    """Return a face at x that looks backwards, from (y, z); a detail has no back."""
    front = Quad(np.array([(x, y, z) for y, z in corners]), slot, 1.0, detail)
    back = Quad(front.corners[::-1], Slot.TRIM, 1.0, False)
    return [front] if detail else [front, back]


def template(quads: Iterable[Quad], x: Span = FULL, y: Span = FULL) -> Template:
    """Join quadrilaterals; x and y are the extent of the footprint."""
    faces = list(quads)
    return Template(
        corners=np.stack([quad.corners.T for quad in faces], axis=2),
        slots=np.array([quad.slot for quad in faces], np.intp),
        shades=np.array([quad.shade for quad in faces]),
        details=np.array([quad.detail for quad in faces]),
        footprint=_rectangle(x, y, 0.0).T[:2],
    )
