"""Build the frames of a model from a driving log."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from driving_logs.commands import command_at
from driving_logs.moments import CameraLog, Floats, LogMoment, LogScene
from driving_logs.pictures import read_picture
from me2e_compress.base.errors import FramesError
from me2e_compress.calibration.dataset import PixelInput
from me2e_compress.runtime.frames import Array, Frame

MADE = (
    "img",
    "lidar2img",
    "can_bus",
    "command",
    "timestamp",
    "l2g_r_mat",
    "l2g_t",
)
"""Inputs that can be made from a log."""


@dataclass(frozen=True)
class InputForm:
    """Shape and type of an input; a side of None is open."""

    shape: tuple[int | None, ...]
    dtype: np.dtype[Any]


@dataclass(frozen=True)
class LoggedInputs:
    """How the inputs of a model are made from a log.

    Attributes:
        image: normalisation and size of the input img; None without one.
        forward_left: whether the model's ground frame is the ego's (x forward, y left)
            instead of the lidar's (x right, y forward).
        width: columns of the image that a picture takes; None means all.
    """

    forms: Mapping[str, InputForm]
    image: PixelInput | None
    forward_left: bool = False
    width: int | None = None

    def check(self, log: CameraLog) -> None:
        """Check that a log can feed the model."""
        # Every input must be one that a log can provide.
        for name in self.forms:
            if name not in MADE:
                raise FramesError(
                    f"input {name} is not made from a log; there are {', '.join(MADE)}"
                    ", and what an adapter makes (--adapter)"
                )
        # The image must have room for the pictures of all cameras.
        image = self.forms.get("img")
        if image is None or self.image is None:
            return
        if self.columns(log, self.image) > self.image.columns:
            raise FramesError(
                f"a picture of {self.columns(log, self.image)} columns (width) is wider"
                f" than the input img: {self.image.columns}"
            )
        if image.dtype != np.float32 or len(image.shape) < 4:
            raise FramesError(
                f"input img is {image.dtype} {list(image.shape)}; from a log it is"
                " float32 [1, cameras, 3, rows, columns]"
            )
        if image.shape[-4] not in (None, len(log.seen)):
            raise FramesError(
                f"input img takes {image.shape[-4]} cameras, the log gives"
                f" {len(log.seen)}: name them (cameras=[CAM_FRONT, ...])"
            )

    def ground(self, now: LogMoment) -> Floats:
        """Return [4, 4] from lidar to the model's ground frame."""
        return now.lidar_to_ego if self.forward_left else np.eye(4)

    def arrays(
        self, log: CameraLog, scene: LogScene, at: int, before: int | None
    ) -> dict[str, Array]:
        """Return the model's inputs at a moment."""
        now = scene[at]
        back = np.linalg.inv(self.ground(now))
        to_world = now.lidar_to_world @ back
        turn = to_world[:3, :3]
        # All inputs are relative to the model's ground frame.
        made: dict[str, Array] = {
            "can_bus": changes(now, None if before is None else scene[before]),
            "command": np.asarray(command_at(log, scene, at)),
            "timestamp": np.asarray((now.time_us - scene[0].time_us) / 1e6),
            "l2g_r_mat": turn.T if now.l2g_rows else turn,
            "l2g_t": to_world[:3, 3],
        }
        # Projections follow the scaling and cropping of pictures.
        projections = [now.lidar_to_image[camera] @ back for camera in log.seen]
        if self.image is not None:
            columns = self.columns(log, self.image)
            pictures = [
                read_picture(now.pictures[camera], self.image, columns)
                for camera in log.seen
            ]
            if len({each.planes.shape for each in pictures}) > 1:
                sizes = [list(each.planes.shape) for each in pictures]
                raise FramesError(
                    f"{now.pictures[log.seen[0]]}: pictures of several sizes: {sizes}"
                )
            made["img"] = np.stack([each.planes for each in pictures])
            places = [each.place for each in pictures]
            projections = [p @ m for p, m in zip(places, projections, strict=True)]
        made["lidar2img"] = np.stack(projections)
        return {name: _fed(made[name], form, name) for name, form in self.forms.items()}

    def columns(self, log: CameraLog, image: PixelInput) -> int:
        """Return the columns of the image that a picture takes."""
        return log.width or self.width or image.columns


class LogFeeder(Protocol):
    """Builds the inputs of a model from the moments of a log."""

    def check(self, log: CameraLog) -> None:
        """Check that a log can feed the model."""
        ...

    def arrays(
        self, log: CameraLog, scene: LogScene, at: int, before: int | None
    ) -> dict[str, Array]:
        """Return the model's inputs at a moment; ``before`` None begins a scene."""
        ...


def log_frames(
    log: CameraLog,
    model: LogFeeder,
    count: int,
    scene_length: int | None = None,
    *,
    done: int = 0,
    first: int = 0,
) -> Iterator[Frame]:
    """Yield frames of a model from a log in order, with images as bytes.

    At most ``count`` frames in all and ``scene_length`` a scene are read. To resume,
    ``done`` frames in whole scenes exist already, and ``first`` is the number of the
    scene to begin with.
    """
    if count < 1 or (scene_length is not None and scene_length < 1):
        raise FramesError(
            f"{count} frames in scenes of {scene_length}: both must be at least 1"
        )
    model.check(log)
    # Take every n-th moment of each scene until there are enough.
    for place, name in list(enumerate(log.chosen()))[first:]:
        scene = log.scene(name)
        chosen = range(0, len(scene), log.every)[
            : min(count - done, scene_length or count)
        ]
        before = None
        for at in chosen:
            # Changes are relative to the last chosen moment.
            arrays = model.arrays(log, scene, at, before)
            yield Frame(done, before is None, arrays, place)
            before, done = at, done + 1
        if done == count:
            return


def changes(now: LogMoment, before: LogMoment | None) -> Floats:
    """Return the CAN bus with changes of position and heading since the last frame.

    UniAD and VAD do the same between their frames; the changes are zero at the first.
    """
    bus = now.can_bus.copy()
    if before is None:
        bus[0:3] = bus[17] = 0.0
        return bus
    bus[0:3] -= before.can_bus[0:3]
    bus[17] = math.remainder(bus[17] - before.can_bus[17], 360.0)
    return bus


def _fed(array: Array, form: InputForm, name: str) -> Array:
    """Return an array with the dimensions and the type of an input."""
    if name == "img":
        lead = (1,) * (len(form.shape) - array.ndim)
        return array.reshape(lead + array.shape)
    # Add leading dimensions of 1, or drop them.
    missing = len(form.shape) - array.ndim
    sides = (1,) * missing + array.shape if missing >= 0 else array.shape[-missing:]
    # Sizes that the model fixes must agree.
    fits = (
        array.size == math.prod(sides)
        and len(sides) == len(form.shape)
        and all(
            want in (None, have) for have, want in zip(sides, form.shape, strict=True)
        )
    )
    if not fits:
        raise FramesError(
            f"input {name} takes {list(form.shape)}, a log gives {list(array.shape)}"
        )
    return array.reshape(sides).astype(form.dtype)
