"""The six cameras of one route."""

from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.cameras.atmosphere import Atmosphere
from me2e_compress.simulator.cameras.classes import PixelClass
from me2e_compress.simulator.cameras.ground import GroundSampler
from me2e_compress.simulator.cameras.painter import Painter, draw, label
from me2e_compress.simulator.cameras.rig import CAMERAS, CameraRig
from me2e_compress.simulator.cameras.sensor import Sensor
from me2e_compress.simulator.cameras.sky import Sky
from me2e_compress.simulator.cameras.solids import solids_of
from me2e_compress.simulator.cameras.texture import GroundTexture
from me2e_compress.simulator.cameras.weather import CLEAR, Weather
from me2e_compress.simulator.scene import Scene

Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Cameras:
    """Renders scenes; the pixels depend on the scene (and its time) alone.

    Args:
        texture: The painted ground of the route, from `paint_texture`.
        rig: The cameras.
        weather: Weather and sensor faults.
    """

    texture: GroundTexture
    rig: CameraRig = field(default_factory=CameraRig)
    weather: Weather = CLEAR

    def __post_init__(self) -> None:
        """Keep OpenCV on one thread: routes run in parallel, one process each."""
        cv2.setNumThreads(1)

    def render(self, scene: Scene) -> Bytes:
        """The six images, uint8 [6, H, W, 3], RGB, in the order of the rig."""
        images = np.empty((*self._shape, 3), np.uint8)
        self._sky.paint(images, scene.ego.heading)
        self._ground.paint(images, self.texture, scene.ego)
        self._atmosphere.veil(images)
        faces = self._painter.faces(solids_of(scene), scene.ego)
        draw(images, faces, self._atmosphere.tint(faces))
        self._sensor.expose(images, scene.time_us)
        return images

    def classes(self, scene: Scene) -> Bytes:
        """What each pixel shows, whatever the weather: `PixelClass`, uint8 [6, H, W].

        A pixel has the class of what its centre sees, edges of solids rounded out.
        """
        labels = np.full(self._shape, PixelClass.SKY, np.uint8)
        self._ground.label(labels, self.texture, scene.ego)
        label(labels, self._painter.faces(solids_of(scene), scene.ego))
        return labels

    @property
    def _shape(self) -> tuple[int, int, int]:
        return len(CAMERAS), self.rig.height, self.rig.width

    @cached_property
    def _sky(self) -> Sky:
        return Sky(self.rig)

    @cached_property
    def _ground(self) -> GroundSampler:
        return GroundSampler(self.rig)

    @cached_property
    def _painter(self) -> Painter:
        return Painter(self.rig)

    @cached_property
    def _atmosphere(self) -> Atmosphere:
        return Atmosphere(self._ground, self.weather)

    @cached_property
    def _sensor(self) -> Sensor:
        return Sensor(self.rig, self.weather)
