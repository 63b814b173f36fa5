"""Estimate joules per frame, with a confidence interval, from windows of a counter."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from me2e_compress.errors import EnergyError

FEWEST_WINDOWS = 5
ENOUGH_FOR_A_BEND = 8
"""Windows from which the drift is fitted by a parabola: warming up slows down."""
HARMONICS = 12
"""Harmonics of the counter's rate that are checked for a beat with the frames."""
SENSED = 0.25
"""Share of a step in which the counter samples the power: 25 ms of 100 ms on A100 and
H100 (Yang, Adamek and Armour, Part-time Power Measurements, SC 2024); other devices
sample longer and beat less."""
UNSURE = 2e-4
"""Share of the counter's step by which a learnt one is off: a poll of 2 ms in 10 s."""
BEATS = 0.05
"""Beat from which frames and counter are no longer independent."""

# Student's t, both sides 95 %, by degrees of freedom (any table of statistics); beyond,
# it is nearly linear in their inverse.
_T = (
    *(12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228),
    *(2.201, 2.179, 2.160, 2.145, 2.131, 2.120, 2.110, 2.101, 2.093, 2.086),
)
_Z = 1.960


@dataclass(frozen=True)
class Window:
    """A run of back-to-back frames between two readings of a counter.

    ``joules`` is the counter's increase; ``paused_s`` the seconds without work between
    frames, see :func:`detuning`.
    """

    begin_s: float
    end_s: float
    frames: int
    joules: float
    paused_s: float = 0.0

    @property
    def taken_s(self) -> float:
        """The length of the window in seconds."""
        return self.end_s - self.begin_s

    @property
    def watts(self) -> float:
        """The mean power."""
        return self.joules / self.taken_s


@dataclass(frozen=True)
class EnergyEstimate:
    """Mean joules per frame over the windows, and the 95 % interval."""

    j_per_frame: float
    low: float
    high: float


def estimate(
    windows: Sequence[Window], step_s: float, idle_w: float | None = None
) -> EnergyEstimate:
    """Return joules per frame over windows of one model, with the 95 % interval.

    A straight line over time (a parabola from :data:`ENOUGH_FOR_A_BEND` windows) is
    fitted to the windows, because warm-up and drift are no noise; Student's t applies
    to the residuals. Windows begin at a random phase of the counter, so that its step,
    its part-time sensing and its noise show in their spread. If the windows lie closer
    together than the step (``step_s``) alone allows, its error replaces the spread: a
    window of whole steps and ``r`` more seconds holds one step more or less by chance,
    a standard deviation of power x sqrt(r (step - r)), for the worst r that the step,
    which is `UNSURE`, leaves open. Energy in pauses lies between
    idle (0 if unknown) and mean power: the middle is subtracted, and half the distance
    is added to the interval in quadrature.
    """
    if len(windows) < FEWEST_WINDOWS:
        raise EnergyError(
            f"energy: {len(windows)} windows: at least {FEWEST_WINDOWS} are needed for"
            " an interval"
        )
    # Subtract the energy of the pauses.
    frames = np.array([each.frames for each in windows], float)
    taken = np.array([each.taken_s for each in windows])
    paused = np.array([each.paused_s for each in windows])
    watts = np.array([each.watts for each in windows])
    idle = 0.0 if idle_w is None else idle_w
    spent = (watts * taken - paused * (watts + idle) / 2) / frames
    # Take the drift over time out of the spread.
    middle = np.array([(each.begin_s + each.end_s) / 2 for each in windows])
    bends = 2 if len(windows) >= ENOUGH_FOR_A_BEND else 1
    free = len(windows) - 1 - bends
    left = spent - np.polynomial.Polynomial.fit(middle, spent, bends)(middle)
    # The spread is at least what the counter's step allows.
    from_whole = np.abs(taken - step_s * np.round(taken / step_s))
    beyond = np.minimum(from_whole + UNSURE * taken, step_s / 2)
    ends = watts / frames * np.sqrt(beyond * (step_s - beyond))
    variance = max(float(left @ left) / free, float(np.mean(ends**2)))
    # Combine noise and the uncertainty of the pauses.
    pauses = float(np.mean(paused * np.abs(watts - idle) / frames)) / 2
    half = math.hypot(student_t(free) * math.sqrt(variance / len(windows)), pauses)
    mean = float(spent.mean())
    return EnergyEstimate(mean, max(0.0, mean - half), mean + half)


def student_t(free: int) -> float:
    """Return the two-sided 95 % quantile of Student's t distribution."""
    if free <= len(_T):
        return _T[free - 1]
    return _Z + (_T[-1] - _Z) * len(_T) / free


def beat(frame_s: float, frames: int, step_s: float) -> float:
    """Return how strongly frames are in step with a counter that samples periodically.

    0: over a window the counter samples all parts of a frame equally; 1: it always
    samples the same part, and so says little about the frame. This is the maximum over
    the harmonics of the counter's rate of the phase agreement of frame starts, weighted
    by the counter's sensitivity to that harmonic. ``frames`` is the number in a window.
    """
    orders = np.arange(1, HARMONICS + 1)
    turns = orders * frame_s / step_s
    # The phases of evenly spaced frames sum to a Dirichlet kernel.
    across = np.abs(np.sin(np.pi * turns))
    agree = np.ones(HARMONICS)
    far = across > 1e-9
    agree[far] = np.abs(np.sin(np.pi * turns[far] * frames)) / (frames * across[far])
    return float(np.max(agree * np.abs(np.sinc(orders * SENSED))))


def detuning(frame_s: float, frames: int, step_s: float) -> float:
    """Return the pause after each frame, in seconds, that keeps a window from beating.

    Frames in step with the counter are delayed so that over a window they fall behind
    by one step, or a whole fraction of one: the counter then samples every part of a
    frame. Returns 0 if they are not in step.
    """
    # Take the shortest pause that suffices, else the best one.
    fractions = [0.0, *(step_s / order for order in range(HARMONICS, 0, -1))]
    pauses = [behind / frames for behind in fractions]
    found = [beat(frame_s + pause, frames, step_s) for pause in pauses]
    least = next((at for at, each in enumerate(found) if each < BEATS), None)
    return pauses[found.index(min(found)) if least is None else least]
