"""From a scene to the solids that the painter draws."""

import math
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.cameras.template import (
    FULL,
    Box,
    Quad,
    Slot,
    Template,
    octagon,
    plate,
    shadow,
    sign_face,
    template,
)
from me2e_compress.simulator.scene import (
    Actor,
    ActorKind,
    Scene,
    SignalKind,
    SignalState,
)

# Shapes of actors and signs, in the unit box; signs are in metres and face -x.


VEHICLE_SHADOW = shadow((-0.53, 0.53), (-0.56, 0.56))
POLE_M = 0.06
# Half width, lower and upper edge. Housing and lamps are half as large again as real
# ones, so that the colour of a lamp is more than a pixel at 25 m, and hang low enough
# that a car waiting at the stop line still has all three in an image.
HOUSING_M = (0.35, 1.3, 2.95)
SIGN_CENTRE_M, SIGN_RADIUS_M = 2.2, 0.5
FOOT = (-0.2, 0.2)


def _wheels(box: Box, u: tuple[float, ...], radius: float, top: float) -> list[Quad]:
    """Build wheels on both sides of a box, from the ground up to v = top.

    ``u`` holds their places from the rear (0) to the front (1); ``radius`` is a share
    of the length of the box, ``top`` of its height.
    """
    low, high = box.faces["left"][0, 2], box.faces["left"][2, 2]
    ground = -low / (high - low)
    radii = radius, (top - ground) / 2
    quads = list[Quad]()
    for at in u:
        for face, along in (("right", at), ("left", 1 - at)):
            quads += box.disc(face, (along, (top + ground) / 2), radii, Slot.TYRE)
    return quads


def _lamps(box: Box, v: tuple[float, float], width: float) -> list[Quad]:
    """Build headlamps, tail lamps and the indicators at the four corners."""
    ends = (0.03, 0.03 + width), (0.97 - width, 0.97)
    # the front's lower edge runs from right to left, the back's from left to right
    quads = [box.on("front", u, v, Slot.HEADLAMP) for u in ends]
    quads += [box.on("back", u, v, Slot.TAIL_LAMP) for u in ends]
    high = (v[0] - (v[1] - v[0]) * 0.9, v[0])
    sides = (Slot.INDICATOR_RIGHT, Slot.INDICATOR_LEFT)
    for u, front, back in zip(ends, sides, sides[::-1], strict=True):
        quads += [box.on("front", u, high, front), box.on("back", u, high, back)]
    return quads


def car() -> Template:
    """Return a car: wheels, lamps, plate, and a cabin with glass all round."""
    body = Box(FULL, FULL, (0.17, 0.54), Slot.BODY)
    cabin = Box(
        (-0.46, 0.26), (-0.47, 0.47), (0.54, 1.0), Slot.BODY, (-0.36, 0.1), (-0.4, 0.4)
    )
    decals = [body.on("back", (0.3, 0.7), (0.3, 0.6), Slot.STRIPE)]
    decals += _lamps(body, (0.52, 0.86), 0.2)
    decals += _wheels(body, (0.19, 0.81), 0.075, 0.45)
    glass = [
        cabin.on(face, (0.07, 0.93), (0.12, 0.9), Slot.GLASS)
        for face in ("front", "back", "left", "right")
    ]
    glass.append(cabin.on("back", (0.38, 0.62), (0.9, 1.0), Slot.THIRD_LAMP))
    return template([VEHICLE_SHADOW, *body.quads(decals), *cabin.quads(glass)])


def van(*, beacon: bool) -> Template:
    """Return a van, or an ambulance with its stripes and its beacon."""
    # lower body with lamps, stripes and wheels
    body = Box(FULL, FULL, (0.15, 0.5), Slot.BODY)
    roof, front = (0.92 if beacon else 1.0), ((-0.5, 0.42), (-0.5, 0.3))
    upper = Box(front[0], FULL, (0.5, roof), Slot.BODY, front[1], (-0.47, 0.47))
    decals = _lamps(body, (0.5, 0.85), 0.16)
    for side in ("left", "right") if beacon else ():
        decals.append(body.on(side, (0.0, 1.0), (0.8, 1.0), Slot.STRIPE))
    decals += _wheels(body, (0.19, 0.81), 0.07, 0.45)
    # upper body with its windows
    windows = (
        ("front", (0.07, 0.93), (0.1, 0.85)),
        ("right", (0.68, 0.95), (0.2, 0.8)),
        ("left", (0.05, 0.32), (0.2, 0.8)),
        ("back", (0.08, 0.47), (0.35, 0.85)),
        ("back", (0.53, 0.92), (0.35, 0.85)),
    )
    glass = [upper.on(*window, Slot.GLASS) for window in windows]
    glass.append(upper.on("back", (0.4, 0.6), (0.9, 1.0), Slot.THIRD_LAMP))
    quads = [VEHICLE_SHADOW, *body.quads(decals), *upper.quads(glass)]
    if beacon:
        bar = Box((0.0, 0.12), (-0.35, 0.35), (roof, 1.0), Slot.BEACON)
        quads += bar.quads()
    return template(quads)


def truck() -> tuple[Template, Template]:
    """Return cargo and cab: two solids, so that the nearer one is painted last."""
    cargo_x, cab_x = (-0.5, 0.18), (0.21, 0.5)
    # cargo on its bed
    bed = Box(cargo_x, FULL, (0.17, 0.32), Slot.TRIM)
    cargo = Box(cargo_x, FULL, (0.32, 1.0), Slot.STRIPE)
    rear = [quad for quad in _lamps(bed, (0.52, 0.95), 0.14) if quad.corners[0, 0] < 0]
    rear += _wheels(bed, (0.3, 0.62), 0.09, 0.5)
    back = [cargo.on("back", (0.49, 0.51), (0.0, 1.0), Slot.TRIM)]
    # cab
    cab = Box(cab_x, FULL, (0.14, 0.82), Slot.BODY)
    front = [quad for quad in _lamps(cab, (0.17, 0.28), 0.14) if quad.corners[0, 0] > 0]
    front += [cab.on("front", (0.06, 0.94), (0.5, 0.92), Slot.GLASS)]
    front += [cab.on("right", (0.35, 0.92), (0.5, 0.9), Slot.GLASS)]
    front += [cab.on("left", (0.08, 0.65), (0.5, 0.9), Slot.GLASS)]
    front += _wheels(cab, (0.5,), 0.23, 0.16)
    cargo_shadow = shadow((-0.52, 0.2), (-0.53, 0.53))
    cab_shadow = shadow((0.2, 0.52), (-0.53, 0.53))
    return (
        template([cargo_shadow, *bed.quads(rear), *cargo.quads(back)], cargo_x, FULL),
        template([cab_shadow, *cab.quads(front)], cab_x, FULL),
    )


def pedestrian() -> Template:
    """Return a pedestrian: legs, torso, head."""
    legs = Box((-0.2, 0.2), (-0.3, 0.3), (0.0, 0.48), Slot.LEGS)
    torso = Box((-0.28, 0.28), (-0.42, 0.42), (0.46, 0.84), Slot.BODY)
    head = Box((-0.18, 0.18), (-0.18, 0.18), (0.86, 1.0), Slot.SKIN)
    return template(
        [shadow((-0.4, 0.4), (-0.4, 0.4)), *legs.quads(), *torso.quads(), *head.quads()]
    )


def bicycle() -> Template:
    """Return a bicycle and its rider."""
    quads = [shadow((-0.5, 0.5), (-0.3, 0.3))]
    # wheels
    for x in (-0.32, 0.32):
        for half, low, high in ((0.18, 0.12, 0.36), (0.09, 0.0, 0.48)):
            corners = [(x - half, 0.0, low), (x + half, 0.0, low)]
            corners += [(x + half, 0.0, high), (x - half, 0.0, high)]
            quads += plate(corners, Slot.TYRE)
    # frame and rider
    frame = Box((-0.3, 0.3), (-0.06, 0.06), (0.25, 0.45), Slot.STRIPE)
    legs = Box((-0.14, 0.1), (-0.25, 0.25), (0.2, 0.52), Slot.LEGS)
    torso = Box(
        (-0.2, 0.08), (-0.38, 0.38), (0.5, 0.83), Slot.BODY, (-0.08, 0.18), (-0.4, 0.4)
    )
    head = Box((0.0, 0.16), (-0.18, 0.18), (0.84, 1.0), Slot.SKIN)
    lamp = frame.on("back", (0.0, 1.0), (0.4, 1.0), Slot.TAIL_LAMP)
    for box, decals in ((frame, [lamp]), (legs, []), (torso, []), (head, [])):
        quads += box.quads(decals)
    return template(quads)


def cone() -> Template:
    """Return a traffic cone with two white bands."""
    base = Box(FULL, FULL, (0.0, 0.05), Slot.TRIM)
    narrow = (-0.08, 0.08)
    cone = Box((-0.36, 0.36), (-0.36, 0.36), (0.05, 1.0), Slot.BODY, narrow, narrow)
    bands = [
        cone.on(face, (0.0, 1.0), v, Slot.STRIPE)
        for face in ("front", "back", "left", "right")
        for v in ((0.3, 0.48), (0.64, 0.8))
    ]
    return template([*base.quads(), *cone.quads(bands)])


def barrier() -> Template:
    """Return a board with stripes, across its heading."""
    foot = Box((-0.5, 0.5), (-0.45, 0.45), (0.0, 0.08), Slot.TRIM)
    board = Box((-0.2, 0.2), FULL, (0.08, 1.0), Slot.BODY)
    bands = [
        board.on(face, (at, at + 0.125), (0.0, 1.0), Slot.STRIPE)
        for face in ("front", "back")
        for at in (0.125, 0.375, 0.625, 0.875)
    ]
    return template([shadow(FULL, FULL), *foot.quads(), *board.quads(bands)])


def door() -> Template:
    """Return an open car door, across the car."""
    panel = Box(FULL, FULL, (0.2, 1.0), Slot.BODY)
    panes = [
        panel.on(face, (0.08, 0.92), (0.55, 0.94), Slot.GLASS)
        for face in ("front", "back")
    ]
    return template([shadow(FULL, FULL), *panel.quads(panes)])


def traffic_light() -> Template:
    """Return a pole with three lamps."""
    half, low, high = HOUSING_M
    housing = Box((-0.15, 0.15), (-half, half), (low, high), Slot.TRIM)
    lamps: list[Quad] = []
    slots = (Slot.LAMP_GREEN, Slot.LAMP_YELLOW, Slot.LAMP_RED)
    for slot, middle in zip(slots, (1 / 6, 1 / 2, 5 / 6), strict=True):
        lamps += housing.disc("back", (0.5, middle), (0.38, 0.148), slot)
    return template([*_pole(low), *housing.quads(lamps)], FOOT, (-half, half))


def stop_sign() -> Template:
    """Return an octagon, white rim, red, with a white bar for the word."""
    quads = _pole(SIGN_CENTRE_M)
    quads += _octagon(-0.08, SIGN_RADIUS_M, Slot.STRIPE, detail=False)
    quads += _octagon(-0.09, SIGN_RADIUS_M * 0.86, Slot.BODY, detail=True)
    half, low, high = SIGN_RADIUS_M * 0.62, SIGN_CENTRE_M - 0.09, SIGN_CENTRE_M + 0.09
    word = [(half, low), (-half, low), (-half, high), (half, high)]
    quads += sign_face(word, -0.1, Slot.STRIPE, detail=True)
    return template(quads, FOOT, (-SIGN_RADIUS_M, SIGN_RADIUS_M))


def give_way_sign() -> Template:
    """Return a triangle on its point, red rim and white."""
    quads = _pole(SIGN_CENTRE_M)
    for scale, x, slot, detail in (
        (1.0, -0.08, Slot.BODY, False),
        (0.58, -0.09, Slot.STRIPE, True),
    ):
        half, low = SIGN_RADIUS_M * 1.15 * scale, SIGN_CENTRE_M - 0.66 * scale
        high = SIGN_CENTRE_M + 0.33 * scale
        corners = [(0.0, low), (0.0, low), (-half, high), (half, high)]
        quads += sign_face(corners, x, slot, detail=detail)
    return template(quads, FOOT, (-SIGN_RADIUS_M, SIGN_RADIUS_M))


def _pole(top_m: float) -> list[Quad]:
    pole = Box((-POLE_M, POLE_M), (-POLE_M, POLE_M), (0.0, top_m), Slot.TRIM)
    return [shadow(FOOT, FOOT), *pole.quads()]


def _octagon(x: float, radius: float, slot: Slot, *, detail: bool) -> list[Quad]:
    """Return three quadrilaterals, seen from behind too if they are no detail."""
    quads = list[Quad]()
    for band in octagon(radius, radius):
        corners = [(-y, SIGN_CENTRE_M + z) for y, z in band]
        quads += sign_face(corners, x, slot, detail=detail)
    return quads


Colour = tuple[int, int, int]
FARTHEST_M = 120.0  # nothing is drawn beyond: a car is less than 3 px wide there
# Half periods: indicators blink 1.4 times a second (60 to 120 a minute by UN Regulation
# 48), beacons 2.5 times
BLINK_US, BEACON_US = 350_000, 200_000

PAINTS: tuple[Colour, ...] = (
    (196, 44, 40),
    (44, 82, 168),
    (196, 198, 202),
    (44, 46, 52),
    (214, 164, 52),
    (72, 118, 92),
    (236, 236, 232),
    (112, 52, 92),
)
CLOTHES: tuple[Colour, ...] = ((176, 60, 168), (220, 92, 40), (40, 132, 176))
FIXED_PAINT: dict[ActorKind, Colour] = {
    ActorKind.EMERGENCY: (240, 240, 236),
    ActorKind.CONE: (244, 112, 28),
    ActorKind.BARRIER: (214, 40, 36),
}
STRIPES: dict[ActorKind, Colour] = {
    ActorKind.EMERGENCY: (222, 32, 40),
    ActorKind.TRUCK: (212, 208, 198),
}
DIM: dict[Slot, Colour] = {
    Slot.SHADOW: (46, 46, 49),
    Slot.TRIM: (62, 64, 68),
    Slot.GLASS: (50, 60, 72),
    Slot.TYRE: (28, 28, 30),
    Slot.SKIN: (214, 164, 132),
    Slot.LEGS: (48, 54, 84),
    Slot.STRIPE: (240, 240, 240),
    Slot.HEADLAMP: (250, 242, 214),
    Slot.TAIL_LAMP: (124, 20, 22),
    Slot.THIRD_LAMP: (70, 24, 26),
    Slot.INDICATOR_LEFT: (150, 92, 30),
    Slot.INDICATOR_RIGHT: (150, 92, 30),
    Slot.BEACON: (28, 50, 130),
    Slot.LAMP_RED: (70, 16, 16),
    Slot.LAMP_YELLOW: (74, 58, 14),
    Slot.LAMP_GREEN: (12, 58, 30),
}
LIT: dict[Slot, Colour] = {
    Slot.TAIL_LAMP: (255, 40, 36),
    Slot.THIRD_LAMP: (255, 40, 36),
    Slot.INDICATOR_LEFT: (255, 176, 24),
    Slot.INDICATOR_RIGHT: (255, 176, 24),
    Slot.BEACON: (80, 160, 255),
    Slot.LAMP_RED: (255, 42, 36),
    Slot.LAMP_YELLOW: (255, 206, 44),
    Slot.LAMP_GREEN: (40, 246, 120),
}
TEMPLATES: dict[ActorKind, tuple[Template, ...]] = {
    ActorKind.CAR: (car(),),
    ActorKind.PARKED: (car(),),
    ActorKind.VAN: (van(beacon=False),),
    ActorKind.EMERGENCY: (van(beacon=True),),
    ActorKind.TRUCK: truck(),
    ActorKind.PEDESTRIAN: (pedestrian(),),
    ActorKind.BICYCLE: (bicycle(),),
    ActorKind.CONE: (cone(),),
    ActorKind.BARRIER: (barrier(),),
    ActorKind.DOOR: (door(),),
}
SIGNS: dict[SignalKind, Template] = {
    SignalKind.TRAFFIC_LIGHT: traffic_light(),
    SignalKind.STOP_SIGN: stop_sign(),
    SignalKind.GIVE_WAY: give_way_sign(),
}
SIGN_RED: Colour = (204, 24, 34)
STATE_LAMPS = {
    SignalState.RED: Slot.LAMP_RED,
    SignalState.YELLOW: Slot.LAMP_YELLOW,
    SignalState.GREEN: Slot.LAMP_GREEN,
}


class Solid(NamedTuple):
    """A template, painted and placed in the world."""

    template: Template
    colours: npt.NDArray[np.float64]  # (faces, 3) RGB, shading applied
    pose: tuple[float, float, float]  # x, y (m) and heading (rad) in the world
    size: tuple[float, float, float]  # length, width and height (m)


def solids_of(scene: Scene) -> list[Solid]:
    """Return every solid of a scene that is near enough to be seen from the ego."""
    ego, solids = scene.ego, list[Solid]()
    for actor in scene.actors:
        if math.hypot(actor.x - ego.x, actor.y - ego.y) < FARTHEST_M:
            solids += _actor_solids(actor, scene.time_us)
    for signal in scene.signals:
        if math.hypot(signal.x - ego.x, signal.y - ego.y) < FARTHEST_M:
            template = SIGNS[signal.kind]
            lit = () if signal.state is None else (STATE_LAMPS[signal.state],)
            colours = _colours(template, SIGN_RED, DIM[Slot.STRIPE], lit)
            pose = (signal.x, signal.y, signal.heading)
            solids.append(Solid(template, colours, pose, (1.0, 1.0, 1.0)))
    return solids


def _actor_solids(actor: Actor, time_us: int) -> list[Solid]:
    # one solid per piece of the actor's shape, with the lamps that are on now
    shown = actor.indicator if time_us // BLINK_US % 2 == 0 else 0
    flashes = actor.kind is ActorKind.EMERGENCY and time_us // BEACON_US % 2 == 0
    pose = actor.x, actor.y, actor.heading
    size = actor.length, actor.width, actor.height
    pieces = _pieces(actor.kind, actor.id, actor.braking, shown, flashes)
    return [Solid(template, colours, pose, size) for template, colours in pieces]


@cache
def _pieces(
    kind: ActorKind, number: int, braking: bool, indicator: int, flashes: bool
) -> list[tuple[Template, npt.NDArray[np.float64]]]:
    """Return the pieces of an actor's shape with the colours of their faces."""
    lit: tuple[Slot, ...] = (Slot.TAIL_LAMP, Slot.THIRD_LAMP) if braking else ()
    if indicator:
        lit += (Slot.INDICATOR_LEFT if indicator > 0 else Slot.INDICATOR_RIGHT,)
    if flashes:
        lit += (Slot.BEACON,)
    # its colour, by its kind or id, is the same in every frame
    people = kind in (ActorKind.PEDESTRIAN, ActorKind.BICYCLE)
    choice = CLOTHES if people else PAINTS
    paint = FIXED_PAINT.get(kind, choice[number * 5 % len(choice)])
    stripe = STRIPES.get(kind, DIM[Slot.STRIPE])
    return [(one, _colours(one, paint, stripe, lit)) for one in TEMPLATES[kind]]


@cache
def _colours(
    template: Template, paint: Colour, stripe: Colour, lit: tuple[Slot, ...]
) -> npt.NDArray[np.float64]:
    """Return [Q, 3] colours of the faces; there are few combinations, so cached."""
    palette = np.array(
        [
            {Slot.BODY: paint, Slot.STRIPE: stripe}.get(slot)
            or (LIT[slot] if slot in lit else DIM[slot])
            for slot in Slot
        ],
        float,
    )
    colours = np.minimum(palette[template.slots] * template.shades[:, None], 255.0)
    colours.flags.writeable = False
    return colours
