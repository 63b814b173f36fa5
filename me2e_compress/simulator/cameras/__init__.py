"""Six pinhole cameras over the painted road: images, and what each pixel shows."""

from me2e_compress.simulator.camera_rig import CAMERA_NAMES, CameraRig
from me2e_compress.simulator.cameras.birdseye import BirdseyeGrid, bev_classes
from me2e_compress.simulator.cameras.classes import PixelClass
from me2e_compress.simulator.cameras.renderer import Cameras
from me2e_compress.simulator.cameras.texture import (
    GroundTexture,
    paint_texture,
)
from me2e_compress.simulator.weather import CLEAR, Weather

__all__ = [
    "CAMERA_NAMES",
    "CLEAR",
    "BirdseyeGrid",
    "CameraRig",
    "Cameras",
    "GroundTexture",
    "PixelClass",
    "Weather",
    "bev_classes",
    "paint_texture",
]
