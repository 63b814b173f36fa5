"""Bench2Drive (Jia et al. 2024): clips of CARLA at 10 Hz, six cameras.

Its files use CARLA's left-handed world (x forward, y right); the moments here are
right-handed, with the lidar turned to x right, y forward, as its UniAD and VAD do.
"""

import gzip
import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, overload

import numpy as np

from driving_logs.framed_log import FramedLog
from driving_logs.moments import (
    CAN_BUS_SIZE,
    Floats,
    LogMoment,
    heading_of,
    intrinsics,
    matrix_of,
)
from me2e_compress.base import documents
from me2e_compress.base.errors import FramesError

PERIOD_US = 100_000
DEEPEST = 3
"""Most folders between the root and ``anno``."""
LARGEST_BYTES = 64_000_000
"""Most bytes of an unpacked annotation; one has about 1 MB."""

_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
"""Left-handed to right-handed, and back."""
_SWAP = np.array([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
"""CARLA's lidar (x forward, y right) to x right, y forward, and back."""
_CAMERA = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
"""A camera's x right, y down, z forward to CARLA's x forward, y right, z up."""


@dataclass(frozen=True)
class Bench2DriveLog(FramedLog):
    """Bench2Drive: folders with anno/ and camera/rgb_*/, at most three below the root.

    Attributes:
        root: the folder that holds the clips, or is one.
        scenes: clips by their folder below the root; empty means all.
        cameras: in the order of the image input; empty means front first.
        every: takes every n-th of 10 pictures a second; UniAD and VAD take 5.
    """

    name: ClassVar[str] = "bench2drive"
    half_second: ClassVar[int] = 5

    root: Path = field(kw_only=False)
    every: int = field(default=5, kw_only=True)

    def names(self) -> Sequence[str]:
        """List the clips by their folder below the root."""
        if not self.root.is_dir():
            raise FramesError(f"{self.root}: no such folder")
        found = [
            str(each.parent.relative_to(self.root))
            for depth in range(DEEPEST)
            for each in sorted(self.root.glob("*/" * depth + "anno"))
            if each.is_dir()
        ]
        if not found:
            raise FramesError(f"{self.root}: holds no clip: a folder with anno/ in it")
        return found

    def scene(self, name: str) -> Sequence[LogMoment]:
        """Return the moments of a clip, which are read lazily."""
        return _Clip(self.root / name, self.seen)

    def command_of(self, right_m: float) -> int:
        """Return "follow the lane"; unused, since every moment has its own command."""
        return 3


class _Clip(Sequence[LogMoment]):
    """A clip whose annotations are read lazily, each once."""

    def __init__(self, folder: Path, cameras: Sequence[str]) -> None:
        self.folder, self.cameras = folder, cameras
        self.files = sorted((folder / "anno").glob("*.json.gz"))
        if not self.files:
            raise FramesError(f"{folder / 'anno'}: holds no .json.gz")
        self._read: dict[int, LogMoment] = {}

    def __len__(self) -> int:
        return len(self.files)

    @overload
    def __getitem__(self, index: int) -> LogMoment: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[LogMoment]: ...
    def __getitem__(self, index: int | slice) -> LogMoment | Sequence[LogMoment]:
        if isinstance(index, slice):
            return [self[at] for at in range(*index.indices(len(self)))]
        if index not in self._read:
            self._read[index] = self._moment(self.files[index])
        return self._read[index]

    def _moment(self, path: Path) -> LogMoment:
        about = _annotation(path)
        number = path.name.partition(".")[0]
        if not number.isdigit():
            raise FramesError(f"{path}: is not named by its number")
        try:
            return self._parse(about, path, number)
        except (LookupError, TypeError, ValueError, OverflowError) as error:
            line = " ".join(str(error).split())[:100]
            said = f"{path}: not an annotation of Bench2Drive ({line})"
            raise FramesError(said) from error

    def _parse(self, about: Mapping[str, Any], path: Path, number: str) -> LogMoment:
        sensors = about["sensors"]
        world_to_lidar = _matrix(sensors["LIDAR_TOP"], "world2lidar", path)
        lidar_to_ego = _matrix(sensors["LIDAR_TOP"], "lidar2ego", path)
        # Turn the left-handed matrices to right-handed ones.
        lidar_to_ego = _MIRROR @ lidar_to_ego @ _SWAP
        lidar_to_world = _inverse(_SWAP @ world_to_lidar @ _MIRROR)
        # Project lidar points into each camera.
        to_image, pictures = dict[str, Floats](), dict[str, Path]()
        for camera in self.cameras:
            if camera not in sensors:
                raise FramesError(f"{path}: has no {camera}")
            looks = _MIRROR @ _matrix(sensors[camera], "cam2ego", path) @ _CAMERA
            inside = intrinsics(sensors[camera]["intrinsic"], f"{path}: {camera}")
            to_image[camera] = inside @ _inverse(looks) @ lidar_to_ego
            view = camera.lower().replace("cam_", "rgb_", 1)
            pictures[camera] = self.folder / "camera" / view / f"{number}.jpg"
        return LogMoment(
            time_us=int(number) * PERIOD_US,
            pictures=pictures,
            lidar_to_image=to_image,
            lidar_to_world=lidar_to_world,
            lidar_to_ego=lidar_to_ego,
            l2g_rows=False,  # Bench2DriveZoo
            can_bus=_can_bus(about, lidar_to_world, path),
            command=_command(about["command_near"], path),
        )


def _annotation(path: Path) -> Mapping[str, Any]:
    try:
        documents.check_regular(path)
        with gzip.open(path) as file:
            text = file.read(LARGEST_BYTES + 1)
        if len(text) > LARGEST_BYTES:
            raise documents.MalformedError(f"more than {LARGEST_BYTES:,} bytes")
        found = documents.from_json(text, finite=False)  # theta may be NaN in CARLA
    except (OSError, EOFError, zlib.error, documents.MalformedError) as error:
        line = " ".join(str(error).split())[:200]
        raise FramesError(f"{path}: not a readable annotation ({line})") from error
    if not isinstance(found, dict):
        raise FramesError(f"{path}: not an annotation of Bench2Drive")
    return found


def _inverse(matrix: Floats) -> Floats:
    return np.asarray(np.linalg.inv(matrix), np.float64)


def _matrix(sensor: Mapping[str, Any], key: str, path: Path) -> Floats:
    return matrix_of(sensor[key], (4, 4), f"{path}: {key}")


def _can_bus(about: Mapping[str, Any], lidar_to_world: Floats, path: Path) -> Floats:
    """Fill the CAN bus as Bench2DriveZoo's UniAD and VAD do."""
    heading = heading_of(lidar_to_world)
    forward, left, up = matrix_of(about["acceleration"], (3,), f"{path}: acceleration")
    rates = matrix_of(about["angular_velocity"], (3,), f"{path}: angular_velocity")
    bus = np.zeros(CAN_BUS_SIZE)
    bus[0], bus[1] = about["x"], -about["y"]
    bus[3], bus[6] = math.cos(heading / 2), math.sin(heading / 2)
    bus[7] = about["speed"] or 0.0  # CARLA's speedometer may say nothing
    bus[10:13] = forward, -left, up
    bus[13:16] = -rates
    bus[16] = heading % (2 * math.pi)
    bus[17] = math.degrees(bus[16])
    return matrix_of(bus, (CAN_BUS_SIZE,), f"{path}: x, y or speed")


def _command(near: object, path: Path) -> int:
    """Return the command from 0; CARLA's void (-1) means to follow the lane."""
    if not isinstance(near, int) or near > 6:
        raise FramesError(f"{path}: command_near {near!r} is none of -1, 1 to 6")
    return (near if near > 0 else 4) - 1
