"""Two drives of one route at the same moment, laid over each other."""

import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.pictures.canvas import write
from me2e_compress.simulator.pictures.route import (
    CAPTION,
    RoutePicture,
    in_column,
    in_row,
)
from me2e_compress.simulator.pictures.top_view import EGO, OTHER, PAPER, OtherDrive

FRONT = ("FRONT_LEFT", "FRONT", "FRONT_RIGHT")


def overlay(one: RoutePicture, other: RoutePicture) -> npt.NDArray[np.uint8]:
    """Draw the last moments of two drives: uint8 [H, W, 3].

    On the left are the front cameras of both, the other's above; on the right is one
    view from above, the other drive under the first in grey. The traffic shown is that
    of ``one``, the drive in colour.
    """
    last, before = len(one.moments) - 1, len(other.moments) - 1
    # front cameras of both drives
    rows = [
        in_row([drive.tile(index, name) for name in FRONT])
        for drive, index in ((other, before), (one, last))
    ]
    cameras = in_column(rows)
    height = cameras.shape[0]
    # one view from above
    moment, then = one.moments[last], other.moments[before]
    view = one.birdseye.draw(
        moment.scene,
        one.trail,
        moment.waypoints,
        (*other.infractions(before), *one.infractions(last)),
        (height, round(height * 0.82)),
        OtherDrive(then.scene.ego, other.trail, then.waypoints),
    )
    picture = in_row([cameras, view])
    # a caption line for each
    caption = np.full((2 * CAPTION, picture.shape[1], 3), PAPER, np.uint8)
    words = [*other.words(before, OTHER, 7), *one.words(last, EGO, 7 + CAPTION)]
    write(caption, words)
    return in_column([picture, caption])
