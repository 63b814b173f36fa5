"""A made-up crossing for the camera tests."""

import math

import cv2
import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.camera_rig import SUBPIXEL_BITS, CameraRig, Weather
from me2e_compress.simulator.cameras.ground import GroundTexture, paint_texture
from me2e_compress.simulator.cameras.painter import Painter
from me2e_compress.simulator.cameras.solids import solids_of
from me2e_compress.simulator.plane_geometry import Lane, LaneMarking, Roadmap
from me2e_compress.simulator.scene import (
    DIMENSIONS,
    Actor,
    ActorKind,
    Ego,
    Scene,
    Signal,
    SignalKind,
    SignalState,
)

STORM = Weather(fog_m=60.0, night=0.5, rain=0.7, brightness=1.1, noise=4.0, seed=3)
STOP_LINE = ((20.0, -2.0), (20.0, 6.0))
CROSSWALK = ((22.0, -2.0), (22.0, 6.0), (26.0, 6.0), (26.0, -2.0))


def lane(y: float, left: LaneMarking, right: LaneMarking) -> Lane:
    stations = np.arange(-200.0, 201.0, 2.0)
    centre = np.stack([stations, np.full_like(stations, y)], axis=1)
    return Lane(f"w>e:{y:g}", centre, 4.0, left, right)


ROADMAP = Roadmap(
    (
        lane(4.0, LaneMarking.SOLID, LaneMarking.NONE),
        lane(0.0, LaneMarking.DASHED, LaneMarking.SOLID),
    ),
    (STOP_LINE,),
    (CROSSWALK,),
)
ROUTE = np.stack([np.arange(0.0, 60.0), np.zeros(60)], axis=1)


def paint() -> GroundTexture:
    return paint_texture(ROADMAP, ROUTE)


def ego(x: float = 0.0, y: float = 0.0, heading: float = 0.0) -> Ego:
    return Ego(x, y, heading, 8.0, 0.0, 0.0, 0.0, 0.0, 4.6, 1.95)


def actor(
    x: float,
    y: float,
    kind: ActorKind = ActorKind.CAR,
    *,
    number: int = 0,
    heading: float = 0.0,
    braking: bool = False,
    indicator: int = 0,
) -> Actor:
    size = DIMENSIONS[kind]
    return Actor(number, kind, x, y, heading, 5.0, *size, braking, indicator)


def scene(*actors: Actor, time_us: int = 0, seen_from: Ego | None = None) -> Scene:
    return Scene(time_us, seen_from or ego(), actors, ())


def light(state: SignalState, x: float = 15.0, y: float = -3.0) -> Scene:
    signal = Signal(1, SignalKind.TRAFFIC_LIGHT, x, y, 0.0, state, STOP_LINE)
    return Scene(0, ego(), (), (signal,))


def covered(rig: CameraRig, scene: Scene) -> npt.NDArray[np.bool_]:
    """Whether a solid, without its shadow and details, covers each pixel: [6, H, W]."""
    mask = np.zeros((6, rig.height, rig.width), np.uint8)
    faces = Painter(rig).faces(solids_of(scene), scene.ego)
    for i in np.flatnonzero(~faces.details).tolist():
        plane, polygon = mask[faces.cameras[i]], faces.polygons[i]
        cv2.fillConvexPoly(plane, polygon, (1,), cv2.LINE_8, SUBPIXEL_BITS)
    return mask.astype(np.bool_)


def busy() -> Scene:
    """One of everything, some of it in the way of a camera."""
    actors, angles = [], np.linspace(0.0, 6.0, len(ActorKind)).tolist()
    for i, (kind, angle) in enumerate(zip(ActorKind, angles, strict=True)):
        x, y, looks = 14 * math.cos(angle), 14 * math.sin(angle), angle + 1.0
        lit, side = i % 2 == 0, i % 3 - 1
        body = actor(x, y, kind, number=i, heading=looks, braking=lit, indicator=side)
        actors.append(body)
    states = (SignalState.RED, None, None)
    signals = tuple(
        Signal(i, kind, 9.0, 3.0 * i - 4.0, 0.1, states[i], STOP_LINE)
        for i, kind in enumerate(SignalKind)
    )
    return Scene(50_000, ego(), (*actors, actor(-2.5, 0.5)), signals)
