"""Estimate joules per frame, with a confidence interval, from windows of a counter."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from me2e_compress.errors import EnergyError

FEWEST_WINDOWS = 5
ENOUGH_FOR_A_BEND = 8
"""Windows from which the drift is fitted by a parabola: warming up slows down."""
UNSURE = 2e-4
"""Share by which the time between two updates of a counter may be off."""

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

    ``joules`` is the counter's increase.
    """

    begin_s: float
    end_s: float
    frames: int
    joules: float

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


def estimate(windows: Sequence[Window], step_s: float) -> EnergyEstimate:
    """Return joules per frame over windows of one model, with the 95 % interval.

    A straight line over time (a parabola from :data:`ENOUGH_FOR_A_BEND` windows) is
    fitted to the windows, because warm-up and drift are no noise; Student's t applies
    to the residuals. Windows begin at a random phase of the counter, so that its step,
    its part-time sensing and its noise show in their spread. If the windows lie closer
    together than the step (``step_s``) alone allows, its error replaces the spread: a
    window of whole steps and ``r`` more seconds holds one step more or less by chance,
    a standard deviation of power x sqrt(r (step - r)), for the worst r that the step,
    which is `UNSURE`, leaves open.
    """
    if len(windows) < FEWEST_WINDOWS:
        raise EnergyError(
            f"energy: {len(windows)} windows: at least {FEWEST_WINDOWS} are needed for"
            " an interval"
        )
    frames = np.array([each.frames for each in windows], float)
    taken = np.array([each.taken_s for each in windows])
    watts = np.array([each.watts for each in windows])
    spent = watts * taken / frames
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
    half = student_t(free) * math.sqrt(variance / len(windows))
    mean = float(spent.mean())
    return EnergyEstimate(mean, max(0.0, mean - half), mean + half)


def student_t(free: int) -> float:
    """Return the two-sided 95 % quantile of Student's t distribution."""
    if free <= len(_T):
        return _T[free - 1]
    return _Z + (_T[-1] - _Z) * len(_T) / free
