"""Six pinhole cameras over the painted road: images, and what each pixel shows."""

from me2e_compress.simulator.camera_rig import CAMERA_NAMES, CLEAR, CameraRig, Weather
from me2e_compress.simulator.cameras.birdseye import BirdseyeGrid, bev_classes
from me2e_compress.simulator.cameras.ground import GroundTexture, paint_texture
from me2e_compress.simulator.cameras.renderer import Cameras
from me2e_compress.simulator.scene import PixelClass

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
