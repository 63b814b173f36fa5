"""Parts of a recording: random samples and held-out frames."""

import bisect
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


def hold_out(
    whole: CalibrationSet, most: int, run: int = 1
) -> tuple[CalibrationSet, CalibrationSet]:
    """Split a recording: frames to calibrate on, and frames to measure on.

    A third of the frames is for measuring, at least one and at most ``most``. They
    stand at equal distances, so that every part of the recording is measured; in runs
    of so many frames of one scene where a state grows along them. A recording of one
    frame is both.
    """
    frames = len(whole)
    if frames == 1:
        return whole, whole
    count = max(1, min(most, -(-frames // 3)))
    ends = [*whole.scenes, frames]
    measured = set[int]()
    for part in range(parts := max(1, count // run)):
        # a run in the middle of its part, and within a scene that is long enough
        length = count // parts + (part < count % parts)
        start = ((2 * part + 1) * frames // parts - length + 1) // 2
        at = bisect.bisect_right(ends, start)
        start = max(ends[at - 1], min(start, ends[at] - length))
        measured.update(range(start, start + length))
    others = [place for place in range(frames) if place not in measured]
    return whole.part(others), whole.part(sorted(measured))
