"""Rides seen by one camera behind the windscreen."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np

from me2e_compress.base.errors import FramesError
from me2e_compress.calibration.dataset import PixelInput
from me2e_compress.calibration.recording import Begin, DriveLog, LogRequest
from me2e_compress.runtime.frames import Frame

PIXELS = PixelInput(
    mean=(123.675, 116.28, 103.53),
    std=(58.395, 57.12, 57.375),
    order="rgb",
    rows=96,
    columns=160,
)
"""How the model takes a picture: statistics of ImageNet."""


@dataclass(frozen=True)
class Dashcam(DriveLog):
    """Files RIDE.npz with pictures [n, 3, h, w], bytes, and speeds [n], m/s.

    Attributes:
        root: the folder that holds the rides.
        every: takes every n-th picture.
    """

    name: ClassVar[str] = "dashcam"

    root: Path = field(kw_only=False)
    every: int = 1

    def frames(self, request: LogRequest, begin: Begin) -> Iterator[Frame]:
        """Yield the inputs ``img`` and ``speed``, from a ride on."""
        index = begin.frame
        rides = list(enumerate(sorted(self.root.glob("*.npz"))))
        if not rides:
            raise FramesError(f"{self.root}: holds no ride: a file RIDE.npz")
        for place, path in rides[begin.place :]:
            with np.load(path) as ride:
                pictures, speeds = ride["pictures"], ride["speeds"]
            chosen = range(0, len(pictures), self.every)[: request.scene_length]
            for at in chosen[: request.count - index]:
                arrays = {
                    "img": pictures[at : at + 1],
                    "speed": speeds[at : at + 1].astype(np.float32),
                }
                yield Frame(index, at == 0, arrays, place)
                index += 1

    def pixels(self, request: LogRequest) -> Mapping[str, PixelInput]:
        """Return that pictures are bytes, and how they are normalised."""
        return {"img": PIXELS}
