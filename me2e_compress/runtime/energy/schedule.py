"""The schedule of an energy measurement: warm-up, idle, and alternating windows."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from me2e_compress.errors import EnergyError
from me2e_compress.runtime.energy.estimate import FEWEST_WINDOWS


@dataclass(frozen=True)
class EnergySchedule:
    """Durations and counts; the paper measures 100 frames after 30 s, once.

    Attributes:
        warm_up_s: work before the first window, seconds, all models together.
        window_s: least seconds of a window: the counter's step of 0.1 s is 1 %.
        window_frames: least frames of a window.
        windows: number of windows of each model.
        idle_s: seconds for which the idle device is measured, before and after.
        lead_in_s: seconds of frames of the same model just before a window: the counter
            lags by a step, and clocks and caches settle.
        seed: of the random phases at which windows begin.
    """

    warm_up_s: float = 30.0
    window_s: float = 10.0
    window_frames: int = 100
    windows: int = 12
    idle_s: float = 10.0
    lead_in_s: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.windows < FEWEST_WINDOWS:
            raise EnergyError(
                f"energy: {self.windows} windows: at least {FEWEST_WINDOWS} are needed"
                " for an interval"
            )
        for name in ("warm_up_s", "window_s", "window_frames", "idle_s", "lead_in_s"):
            value = getattr(self, name)
            if not (0 < value < math.inf):
                raise EnergyError(f"energy: {name} {value:g} is not a positive number")
        if self.seed < 0:
            raise EnergyError(f"energy: seed {self.seed}: must be 0 or more")

    def frames(self, frame_s: float) -> int:
        """Return the frames in a window of a model that takes ``frame_s`` a frame."""
        return max(self.window_frames, math.ceil(self.window_s / frame_s))

    def turns(self, models: Sequence[str]) -> list[str]:
        """Return the models in order of their windows: A B B A spreads drift evenly."""
        there, back = list(models), list(reversed(models))
        return [
            each
            for turn in range(self.windows)
            for each in (back if turn % 2 else there)
        ]
