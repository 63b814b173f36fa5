"""From a scene to the solids that the painter draws."""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.cameras import shapes
from me2e_compress.simulator.cameras.classes import ACTOR_CLASSES, PixelClass
from me2e_compress.simulator.cameras.template import Slot, Template
from me2e_compress.simulator.scene import (
    Actor,
    ActorKind,
    Scene,
    Signal,
    SignalKind,
    SignalState,
)

Colour = tuple[int, int, int]
FARTHEST_M = 120.0
"""What is further from the ego is not drawn: a car is less than 3 px wide there."""
BLINK_US, BEACON_US = 350_000, 200_000
"""Half periods: indicators blink 1.4 times a second (60 to 120 a minute by UN
Regulation 48), beacons 2.5 times."""

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
    ActorKind.CAR: (shapes.car(),),
    ActorKind.PARKED: (shapes.car(),),
    ActorKind.VAN: (shapes.van(beacon=False),),
    ActorKind.EMERGENCY: (shapes.van(beacon=True),),
    ActorKind.TRUCK: shapes.truck(),
    ActorKind.PEDESTRIAN: (shapes.pedestrian(),),
    ActorKind.BICYCLE: (shapes.bicycle(),),
    ActorKind.CONE: (shapes.cone(),),
    ActorKind.BARRIER: (shapes.barrier(),),
    ActorKind.DOOR: (shapes.door(),),
}
SIGNS: dict[SignalKind, tuple[Template, PixelClass]] = {
    SignalKind.TRAFFIC_LIGHT: (shapes.traffic_light(), PixelClass.TRAFFIC_LIGHT),
    SignalKind.STOP_SIGN: (shapes.stop_sign(), PixelClass.TRAFFIC_SIGN),
    SignalKind.GIVE_WAY: (shapes.give_way_sign(), PixelClass.TRAFFIC_SIGN),
}
SIGN_RED: Colour = (204, 24, 34)
STATE_LAMPS = {
    SignalState.RED: Slot.LAMP_RED,
    SignalState.YELLOW: Slot.LAMP_YELLOW,
    SignalState.GREEN: Slot.LAMP_GREEN,
}


@dataclass(frozen=True, slots=True)
class Solid:
    """A template, painted and placed in the world.

    Attributes:
        colours: float64 [Q, 3] RGB of its faces, shading applied.
        pose: x, y, heading in the world; metres and radians.
        size: Length, width, height in metres.
        kind: Class of its pixels.
    """

    template: Template
    colours: npt.NDArray[np.float64]
    pose: tuple[float, float, float]
    size: tuple[float, float, float]
    kind: PixelClass


def solids_of(scene: Scene) -> list[Solid]:
    """Return every solid of a scene that is near enough to be seen from the ego."""
    ego, solids = scene.ego, list[Solid]()
    for actor in scene.actors:
        if math.hypot(actor.x - ego.x, actor.y - ego.y) < FARTHEST_M:
            solids += _actor_solids(actor, scene.time_us)
    for signal in scene.signals:
        if math.hypot(signal.x - ego.x, signal.y - ego.y) < FARTHEST_M:
            solids.append(_signal_solid(signal))
    return solids


def _actor_solids(actor: Actor, time_us: int) -> list[Solid]:
    # lamps that are on at this instant
    lit: list[Slot] = []
    if actor.braking:
        lit += [Slot.TAIL_LAMP, Slot.THIRD_LAMP]
    if actor.indicator and time_us // BLINK_US % 2 == 0:
        left = actor.indicator > 0
        lit.append(Slot.INDICATOR_LEFT if left else Slot.INDICATOR_RIGHT)
    if actor.kind is ActorKind.EMERGENCY and time_us // BEACON_US % 2 == 0:
        lit.append(Slot.BEACON)
    # one solid per piece of the actor's shape
    paint, stripe = _paint(actor), STRIPES.get(actor.kind, DIM[Slot.STRIPE])
    return [
        Solid(
            template,
            _colours(template, paint, stripe, tuple(lit)),
            (actor.x, actor.y, actor.heading),
            (actor.length, actor.width, actor.height),
            ACTOR_CLASSES[actor.kind],
        )
        for template in TEMPLATES[actor.kind]
    ]


def _paint(actor: Actor) -> Colour:
    """Return an actor's colour, by its kind or id, the same in every frame."""
    if actor.kind in FIXED_PAINT:
        return FIXED_PAINT[actor.kind]
    people = actor.kind in (ActorKind.PEDESTRIAN, ActorKind.BICYCLE)
    choice = CLOTHES if people else PAINTS
    return choice[actor.id * 5 % len(choice)]


def _signal_solid(signal: Signal) -> Solid:
    template, kind = SIGNS[signal.kind]
    lit = () if signal.state is None else (STATE_LAMPS[signal.state],)
    colours = _colours(template, SIGN_RED, DIM[Slot.STRIPE], lit)
    pose = (signal.x, signal.y, signal.heading)
    return Solid(template, colours, pose, (1.0, 1.0, 1.0), kind)


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
