"""Parts of a recording: random samples and held-out frames."""

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.errors import FramesError
from me2e_compress.runtime.frames import Frame


@dataclasses.dataclass(frozen=True)
class FrameSubset:
    """Some of the frames of a recording, in its order; the first starts a scene.

    ``places`` are indices in the whole recording.
    """

    whole: CalibrationSet
    places: tuple[int, ...]

    @property
    def fingerprint(self) -> str:
        """The fingerprint of the whole recording, to check later frames against."""
        return self.whole.fingerprint

    @property
    def scenes(self) -> tuple[int, ...]:
        """Positions among these frames where a scene begins."""
        starts = {0, *self.whole.scenes}
        return tuple(
            at for at, place in enumerate(self.places) if not at or place in starts
        )

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, index: int) -> Frame:
        """Read one frame; its index is that in the whole recording."""
        frame = self.whole[self.places[index]]
        return frame if index else dataclasses.replace(frame, starts_scene=True)

    def __iter__(self) -> Iterator[Frame]:
        """Read the frames in order, one in memory at a time."""
        return (self[index] for index in range(len(self)))


def draw(whole: CalibrationSet, count: int, seed: int) -> FrameSubset:
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
    return FrameSubset(whole, tuple(sorted(drawn[:count])))


def hold_out(whole: CalibrationSet, most: int) -> tuple[FrameSubset, FrameSubset]:
    """Split a recording: frames to calibrate on, and frames to measure on.

    A quarter of the frames is for measuring, at least one and at most ``most``. They
    are the last ones; where scenes are short enough, none of their scene is calibrated
    on, since neighbours in a scene look alike. A recording of one frame is both.
    """
    frames = len(whole)
    if frames == 1:
        return FrameSubset(whole, (0,)), FrameSubset(whole, (0,))
    count = max(1, min(most, frames // 4))
    cut = frames - count
    # Move the cut to the start of a scene if that leaves enough.
    scene = max(start for start in whole.scenes if start <= cut)
    if scene >= frames / 2:
        cut = scene
    return (
        FrameSubset(whole, tuple(range(cut))),
        FrameSubset(whole, tuple(range(cut, cut + count))),
    )
