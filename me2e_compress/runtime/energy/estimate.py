"""Joules a frame from windows of a counter, with an interval that holds them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from me2e_compress.errors import EnergyError

FEWEST_WINDOWS = 5
ENOUGH_FOR_A_BEND = 8
"""Windows from which a drift may be bent: a chip that settles warms up ever slower."""
HARMONICS = 12
"""Of the counter's rate that are looked at for a beat with the frames."""
SENSED = 0.25
"""Share of a step in which the counter looks at the power: 25 ms of 100 ms on A100 and
H100 (Yang, Adamek and Armour, Part-time Power Measurements, SC 2024); other devices
look longer, and beat less."""
BEATS = 0.05
"""Beat from which frames and counter are not independent any more."""

# Student's t, both sides 95 %, by degrees of freedom (any table of statistics); beyond,
# it is nearly linear in their inverse.
_T = (
    *(12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228),
    *(2.201, 2.179, 2.160, 2.145, 2.131, 2.120, 2.110, 2.101, 2.093, 2.086),
)
_Z = 1.960


@dataclass(frozen=True)
class Window:
    """A stretch of frames back to back, between two readings of a counter.

    Attributes:
        begin_s: When the counter was read first, seconds.
        end_s: When it was read last.
        frames: Inferences between.
        joules: What the counter moved.
        paused_s: Seconds without work between frames, see :func:`detuning`.
    """

    begin_s: float
    end_s: float
    frames: int
    joules: float
    paused_s: float = 0.0

    @property
    def taken_s(self) -> float:
        """Seconds."""
        return self.end_s - self.begin_s

    @property
    def watts(self) -> float:
        """Mean power."""
        return self.joules / self.taken_s


@dataclass(frozen=True)
class EnergyEstimate:
    """Joules a frame and their 95 % interval.

    Attributes:
        j_per_frame: Mean over the windows.
        low: Lower end, not below 0.
        high: Upper end.
    """

    j_per_frame: float
    low: float
    high: float


def estimate(
    windows: Sequence[Window], step_s: float, idle_w: float | None = None
) -> EnergyEstimate:
    """Return joules a frame over windows of one model, and how well they are known.

    The mean of the windows, and Student's t over what is left of them after a straight
    line over time: what warms up or drifts is no noise. Windows begin at a random phase
    of the counter, so that its step, its part-time sensing and its noise are in their
    spread. Where windows happen to lie closer than the step alone allows, its share
    stands in for the spread: a window of so many steps and ``r`` seconds holds a step
    more or less by chance, a standard deviation of power x sqrt(r (step - r)). What the
    pauses took lies between idle and mean power: the middle is taken off, and half the
    distance added to the interval, in quadrature.

    Args:
        windows: At least :data:`FEWEST_WINDOWS`, at random phases of the counter, each
            after frames of the same model.
        step_s: Seconds from one value of the counter to the next.
        idle_w: Watts of the idle device; None: somewhere from 0 up.

    Raises:
        EnergyError: Too few windows.
    """
    if len(windows) < FEWEST_WINDOWS:
        raise EnergyError(
            f"energy: {len(windows)} windows: at least {FEWEST_WINDOWS} are needed for"
            " an interval"
        )
    frames = np.array([each.frames for each in windows], float)
    taken = np.array([each.taken_s for each in windows])
    paused = np.array([each.paused_s for each in windows])
    watts = np.array([each.watts for each in windows])
    idle = 0.0 if idle_w is None else idle_w
    spent = (watts * taken - paused * (watts + idle) / 2) / frames
    middle = np.array([(each.begin_s + each.end_s) / 2 for each in windows])
    bends = 2 if len(windows) >= ENOUGH_FOR_A_BEND else 1
    free = len(windows) - 1 - bends
    left = spent - np.polynomial.Polynomial.fit(middle, spent, bends)(middle)
    beyond = taken % step_s  # of whole steps: what the two ends can differ by
    ends = watts / frames * np.sqrt(beyond * (step_s - beyond))
    variance = max(float(left @ left) / free, float(np.mean(ends**2)))
    pauses = float(np.mean(paused * np.abs(watts - idle) / frames)) / 2
    half = math.hypot(student_t(free) * math.sqrt(variance / len(windows)), pauses)
    mean = float(spent.mean())
    return EnergyEstimate(mean, max(0.0, mean - half), mean + half)


def student_t(free: int) -> float:
    """Return Student's t, both sides 95 %, for so many degrees of freedom."""
    if free <= len(_T):
        return _T[free - 1]
    return _Z + (_T[-1] - _Z) * len(_T) / free


def beat(frame_s: float, frames: int, step_s: float) -> float:
    """Return how far frames keep step with a counter that looks at set moments.

    0: over a window the counter looks at every part of a frame alike; 1: always at the
    same, so that it tells little of the frame. Of the harmonics of its rate, the
    largest of how well the beginnings of frames agree in phase, weighed with how well
    it sees that harmonic.

    Args:
        frame_s: From frame to frame, seconds.
        frames: Of a window.
        step_s: Of the counter.
    """
    orders = np.arange(1, HARMONICS + 1)
    turns = orders * frame_s / step_s
    across = np.abs(np.sin(np.pi * turns))
    agree = np.ones(HARMONICS)
    far = across > 1e-9
    agree[far] = np.abs(np.sin(np.pi * turns[far] * frames)) / (frames * across[far])
    return float(np.max(agree * np.abs(np.sinc(orders * SENSED))))


def detuning(frame_s: float, frames: int, step_s: float) -> float:
    """Return the pause after each frame that keeps a window from beating, seconds.

    Frames that keep step with the counter are held up by so little that over a window
    they fall behind by one step of it, or a whole fraction of one: it then looks at
    every part of a frame. 0 where they do not keep step.
    """
    fractions = [0.0, *(step_s / order for order in range(HARMONICS, 0, -1))]
    pauses = [behind / frames for behind in fractions]
    found = [beat(frame_s + pause, frames, step_s) for pause in pauses]
    least = next((at for at, each in enumerate(found) if each < BEATS), None)
    return pauses[found.index(min(found)) if least is None else least]
