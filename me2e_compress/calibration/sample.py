"""Parts of a recording: random samples and held-out frames."""

import itertools

import numpy as np

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.errors import FramesError


def draw(whole: CalibrationSet, count: int, seed: int) -> CalibrationSet:
    """Draw ``count`` frames by ``seed``, scene by scene without replacement.

    Scenes stay complete, since recurrent state grows along them; only the last one
    drawn is cut at its end. A shorter recording is taken whole: no frame counts twice.
    """
    if count < 1:
        raise FramesError(f"{count} frames were asked for; at least 1 is needed")
    ends = [*whole.scenes, len(whole)]
    scenes = [range(start, end) for start, end in itertools.pairwise(ends)]
    order = np.random.default_rng(seed).permutation(len(scenes)).tolist()
    drawn = [place for at in order for place in scenes[at]]
    return whole.part(sorted(drawn[:count]))


def hold_out(whole: CalibrationSet, most: int) -> tuple[CalibrationSet, CalibrationSet]:
    """Split a recording: frames to calibrate on, and frames to measure on.

    A quarter of the frames is for measuring, at least one and at most ``most``. They
    are the last ones; where scenes are short enough, none of their scene is calibrated
    on, since neighbours in a scene look alike. A recording of one frame is both.
    """
    frames = len(whole)
    if frames == 1:
        return whole, whole
    count = max(1, min(most, frames // 4))
    cut = frames - count
    # Move the cut to the start of a scene if that leaves enough.
    scene = max(start for start in whole.scenes if start <= cut)
    if scene >= frames / 2:
        cut = scene
    return whole.part(range(cut)), whole.part(range(cut, cut + count))
