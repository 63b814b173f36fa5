"""An ego that turns left, for tests of the inputs of models."""

import math

import numpy as np
import numpy.typing as npt

from me2e_compress.driving.contract import EgoKinematics, Observation
from me2e_compress.driving.input_sources import (
    INPUT_SOURCES,
    Axes,
    EgoTrack,
    Observed,
    can_bus_between,
)
from me2e_compress.simulator.camera_rig import CameraRig

RIG = CameraRig(90, 160)


def motion(x: float, y: float, heading: float, speed: float = 6.0) -> EgoKinematics:
    return EgoKinematics(x, y, heading, speed, (1.0, 2.0, 9.0), (0.0, 0.0, 0.5))


def observation(
    now: EgoKinematics,
    time_us: int = 1_000_000,
    images: npt.NDArray[np.uint8] | None = None,
) -> Observation:
    before = motion(now.x - 3.0, now.y, now.heading - 0.1)
    return Observation(
        time_us,
        images,
        RIG.lidar2img,
        can_bus_between(now, before),
        3,
        now.speed_mps,
        motion=now,
        target_points=np.array([[20.0, 5.0], [60.0, -10.0]], np.float32),
    )


def observed(axes: Axes = Axes.FORWARD_LEFT) -> Observed:
    """A second of driving north from (10, 0), at 4 and then 6 m/s."""
    track, north = EgoTrack(), math.pi / 2
    track.note(0, motion(10.0, 0.0, north, 4.0))
    track.note(500_000, motion(10.0, 2.0, north, 4.0))
    now = motion(10.0, 5.0, north)
    track.note(1_000_000, now)
    seen = observation(now)
    return Observed(seen, axes, track, {"": seen.lidar2img})


def value(text: str, axes: Axes = Axes.FORWARD_LEFT) -> npt.NDArray[np.float64]:
    """Return what a source gives there, by its text."""
    return np.asarray(INPUT_SOURCES.parse(text).value(observed(axes)), np.float64)
