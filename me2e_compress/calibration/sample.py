"""Parts of a recording: random samples and held-out frames."""

import bisect
import itertools

import numpy as np

from me2e_compress.base.errors import FramesError
from me2e_compress.calibration.dataset import CalibrationSet


def draw(whole: CalibrationSet, count: int, seed: int) -> CalibrationSet:
    """Draw ``count`` frames by ``seed``, scene by scene without replacement."""
    if count < 1:
        raise FramesError(f"{count} frames were asked for; at least 1 is needed")
    # Scenes stay complete, since recurrent state grows along them; only the last one
    # drawn is cut at its end. A shorter recording is taken whole: no frame counts twice
    ends = [*whole.scenes, len(whole)]
    scenes = [range(start, end) for start, end in itertools.pairwise(ends)]
    order = np.random.default_rng(seed).permutation(len(scenes)).tolist()
    drawn = [place for at in order for place in scenes[at]]
    return whole.part(sorted(drawn[:count]))


def spread(whole: CalibrationSet, count: int, run: int = 1) -> CalibrationSet:
    """Pick frames at equal distances, in runs, so that all of a recording is seen."""
    frames, picked = len(whole), set[int]()
    ends, count = [*whole.scenes, frames], min(count, frames)
    # A run is of one scene: a state grows along it
    for part in range(parts := max(1, count // run)):
        # a run in the middle of its part, and within a scene that is long enough
        length = count // parts + (part < count % parts)
        start = ((2 * part + 1) * frames // parts - length + 1) // 2
        at = bisect.bisect_right(ends, start)
        start = max(ends[at - 1], min(start, ends[at] - length))
        picked.update(range(start, start + length))
    return whole.part(sorted(whole.places[place] for place in picked))


def hold_out(
    whole: CalibrationSet, most: int, run: int = 1
) -> tuple[CalibrationSet, CalibrationSet]:
    """Split a recording: frames to calibrate on, and frames to measure on."""
    if len(whole) == 1:
        # One frame is both
        return whole, whole
    # A third of the frames is for measuring
    measured = spread(whole, max(1, min(most, -(-len(whole) // 3))), run)
    others = sorted(set(whole.places) - set(measured.places))
    return whole.part(others), measured
