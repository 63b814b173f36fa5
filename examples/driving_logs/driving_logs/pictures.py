"""Decode a log's pictures to an image input, and return the pixel transform.

Sizes follow the published stacks: a picture is scaled to the given columns; if it is
then too tall it loses its upper rows (Lift-Splat, BEVDet, SparseDrive), if too small
it is padded below and to the right when fed (mmdetection, UniAD, VAD: 1600 x 900 at
0.4 is 640 x 360, padded to 384 rows).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from driving_logs.moments import Floats
from me2e_compress.base.documents import MalformedError, check_regular
from me2e_compress.base.errors import FramesError
from me2e_compress.calibration.dataset import PixelInput

Bytes: TypeAlias = npt.NDArray[np.uint8]

_JPEG, _PNG = b"\xff\xd8", b"\x89PNG"


@dataclass(frozen=True)
class Picture:
    """A decoded picture, uint8 [3, h, w], at most as large as the input.

    ``place`` [4, 4] leads from pixels of the whole picture to those of the input, both
    times depth.
    """

    planes: Bytes
    place: Floats


def read_picture(path: Path, pixels: PixelInput, columns: int) -> Picture:
    """Read a JPEG or PNG and lay it out for an input of which it takes ``columns``."""
    import cv2  # takes a tenth of a second to import

    found = _decoded(path)
    height, width = found.shape[:2]
    # Scale to the columns, and keep the aspect ratio.
    rows = max(1, round(height * columns / width))
    if (rows, columns) != (height, width):
        found = np.asarray(cv2.resize(found, (columns, rows)), np.uint8)
    # Crop at the top, and order the channels.
    above = max(0, rows - pixels.rows)
    order = slice(None, None, -1) if pixels.order == "rgb" else slice(None)
    planes = np.moveaxis(found[above:, :, order], -1, 0)
    place = np.diag([columns / width, rows / height, 1.0, 1.0])
    place[1, 2] = -above
    return Picture(np.ascontiguousarray(planes, np.uint8), place)


def read_pixels(path: Path, size: tuple[int, int]) -> tuple[Bytes, Floats]:
    """Read a JPEG or PNG and scale it to ``size`` (rows, columns) without cropping.

    Returns RGB [rows, columns, 3], and [4, 4] from pixels of the picture to those, both
    times depth.
    """
    import cv2

    found, (rows, columns) = _decoded(path), size
    height, width = found.shape[:2]
    if size != (height, width):
        found = np.asarray(cv2.resize(found, (columns, rows)), np.uint8)
    place = np.diag([columns / width, rows / height, 1.0, 1.0])
    return np.ascontiguousarray(found[..., ::-1], np.uint8), place


def _decoded(path: Path) -> Bytes:
    """Return BGR [h, w, 3]."""
    import cv2

    try:
        check_regular(path)
        content = path.read_bytes()
    except OSError as error:
        raise FramesError(f"{path}: {error.strerror}") from error
    except MalformedError as error:
        raise FramesError(f"{path}: {error}") from error
    # Check the end before decoding: OpenCV would not.
    if not _is_whole(content):
        raise FramesError(f"{path}: the picture breaks off, or is no JPEG or PNG")
    found = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    if found is None:
        raise FramesError(f"{path}: not a readable picture")
    return np.asarray(found, np.uint8)


def _is_whole(content: bytes) -> bool:
    """Look for the end marker: OpenCV pads truncated pictures with grey."""
    if content.startswith(_JPEG):  # a thumbnail ends before the picture begins
        return content.rfind(b"\xff\xd9") > content.rfind(b"\xff\xda")
    return content.startswith(_PNG) and b"IEND" in content[-16:]
