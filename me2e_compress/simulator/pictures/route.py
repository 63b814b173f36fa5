"""Pictures of recorded moments, and their PNG and GIF files."""

import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image

from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.atomic import write_bytes
from me2e_compress.simulator.camera_rig import CAMERA_NAMES
from me2e_compress.simulator.cameras.ground import GroundTexture
from me2e_compress.simulator.pictures.top_view import (
    INK,
    PAPER,
    BirdsEye,
    Colour,
    Text,
    text_width,
    write,
)
from me2e_compress.simulator.scene import INFRACTIONS, Event, Scene

Bytes = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float64]

MONTAGE = (("FRONT_LEFT", "FRONT", "FRONT_RIGHT"), ("BACK_LEFT", "BACK", "BACK_RIGHT"))
"""As in nuScenes' figures. Rear images are not mirrored: in BACK, what is to the left
of the car is to the right of the image."""
GAP = 4
CAPTION = 30
RED = (208, 16, 32)


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """The record of one frame.

    Attributes:
        scene: The whole scene.
        images: The six cameras, uint8 [6, H, W, 3] RGB.
        plan: [n, 2] metres in the ego frame: the plan in force; None before the first,
            and for a policy that answers controls.
        events: Events, at least since the moment before; a repeated event is drawn
            once.
    """

    scene: Scene
    images: Bytes
    plan: Floats | None = None
    events: tuple[Event, ...] = ()


@dataclass(frozen=True, eq=False)
class RoutePicture:
    """Draws a route from its recorded moments.

    Args:
        title: First words of the caption: the scenario, the route, the driver.
        texture: The ground the route was driven on.
        route: [N, 2] world points of the route.
        moments: In order of time, at least one.
        tile_width: Width of a camera's tile in pixels.
    """

    title: str
    texture: GroundTexture
    route: Floats
    moments: Sequence[Moment]
    tile_width: int = 320

    def __post_init__(self) -> None:
        if not self.moments:
            raise EvaluationError(f"{self.title}: no moments to draw")

    def frame(self, index: int) -> Bytes:
        """Draw the six cameras, the view from above and a caption: uint8 [H, W, 3]."""
        rows = [in_row([self.tile(index, name) for name in names]) for names in MONTAGE]
        montage = in_column(rows)
        height = montage.shape[0]
        above = self._from_above(index, (height, round(height * 0.82)))
        picture = in_row([montage, above])
        caption = np.full((CAPTION, picture.shape[1], 3), PAPER, np.uint8)
        write(caption, self.words(index, INK, 7))
        return in_column([picture, caption])

    def frames(self) -> Iterable[Bytes]:
        """Yield all moments."""
        return map(self.frame, range(len(self.moments)))

    def strip(self, indices: Sequence[int]) -> Bytes:
        """Draw moments side by side, the front camera above the view from above."""
        columns = []
        for index in indices:
            tile = self.tile(index, "FRONT")
            side = tile.shape[1]
            above = self._from_above(index, (side, side))
            label = np.full((CAPTION, side, 3), PAPER, np.uint8)
            write(label, [Text(_state(self.moments[index]), 4, 7, 14, INK)])
            columns.append(in_column([label, tile, above]))
        return in_row(columns)

    def tile(self, index: int, name: str) -> Bytes:
        """Draw one camera's image, with its name."""
        tile = self.moments[index].images[CAMERA_NAMES.index(name)]
        height = round(self.tile_width * tile.shape[0] / tile.shape[1])
        large = cv2.resize(
            tile, (self.tile_width, height), interpolation=cv2.INTER_LINEAR
        )
        pixels = np.asarray(large, np.uint8)
        write(pixels, [Text(name, 5, 3, 12, PAPER, INK)])
        return pixels

    def _from_above(self, index: int, size: tuple[int, int]) -> Bytes:
        moment = self.moments[index]
        trail = self.trail[: index + 1]
        return self.birdseye.draw(
            moment.scene, trail, moment.plan, self.infractions(index), size
        )

    def words(self, index: int, colour: Colour, row: int) -> list[Text]:
        """Return title, time and speed at a height of the caption; infractions red."""
        caption = f"{self.title}   {_state(self.moments[index])}"
        texts = [Text(caption, 6, row, 15, colour)]
        done = self.infractions(index)
        if done:
            names = list(dict.fromkeys(e.kind.replace("_", " ") for e in done))
            left = 6 + text_width(caption, 15) + 16
            texts.append(Text(", ".join(names), left, row, 15, RED))
        return texts

    def infractions(self, index: int) -> tuple[Event, ...]:
        """Return the infractions up to a moment, each once, in order."""
        events = (e for moment in self.moments[: index + 1] for e in moment.events)
        return tuple(dict.fromkeys(e for e in events if e.kind in INFRACTIONS))

    @cached_property
    def trail(self) -> Floats:
        """[N, 2] positions of the ego, world metres."""
        return np.array([(m.scene.ego.x, m.scene.ego.y) for m in self.moments])

    @cached_property
    def birdseye(self) -> BirdsEye:
        """The drawer of the view from above."""
        return BirdsEye(self.texture, self.route)


def _state(moment: Moment) -> str:
    scene = moment.scene
    return f"t = {scene.time_us / 1e6:.2f} s   {scene.ego.speed_mps:.1f} m/s"


def in_row(pictures: list[Bytes]) -> Bytes:
    """Put pictures of one height side by side."""
    gap = np.full((pictures[0].shape[0], GAP, 3), PAPER, np.uint8)
    parts = [part for picture in pictures for part in (picture, gap)]
    return np.concatenate(parts[:-1], axis=1)


def in_column(pictures: list[Bytes]) -> Bytes:
    """Put pictures of one width below each other."""
    gap = np.full((GAP, pictures[0].shape[1], 3), PAPER, np.uint8)
    parts = [part for picture in pictures for part in (picture, gap)]
    return np.concatenate(parts[:-1], axis=0)


COLOURS = 256


def write_png(path: Path, picture: Bytes) -> None:
    """Write uint8 [H, W, 3] as PNG."""
    _replace(path, partial(Image.fromarray(picture).save, format="PNG"))


def write_gif(path: Path, pictures: Iterable[Bytes], frame_us: int) -> None:
    """Write an animation of one or more uint8 [H, W, 3] that loops, with one palette.

    ``frame_us`` is rounded to hundredths of a second, as GIF has them.

    Raises:
        EvaluationError: There is no picture, or the file cannot be written.
    """
    images = [Image.fromarray(picture) for picture in pictures]
    if not images:
        raise EvaluationError(f"{path}: an animation needs at least one picture")
    # the 256 colours of a few frames from the whole animation
    chosen = images[:: max(1, len(images) // 6)]
    sheet = np.concatenate([np.asarray(image) for image in chosen])
    palette = Image.fromarray(sheet).quantize(COLOURS, Image.Quantize.MEDIANCUT)
    frames = [
        image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images
    ]
    save = partial(
        frames[0].save,
        format="GIF",
        save_all=True,
        append_images=frames[1:],
        duration=max(20, round(frame_us / 10_000) * 10),
        loop=0,
        optimize=False,
    )
    _replace(path, save)


def _replace(path: Path, save: Callable[[io.BytesIO], Any]) -> None:
    content = io.BytesIO()
    save(content)
    try:
        write_bytes(path, content.getvalue())
    except OSError as error:
        raise EvaluationError(
            f"{path}: the picture cannot be written: {error.strerror or error}"
        ) from error
