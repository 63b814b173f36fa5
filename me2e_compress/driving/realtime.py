"""Real-time synchronous simulation: the world waits, then charges for the wait.

Equation 4: a decision that took t costs n = max(0, int(t / dt) - 1) decisions. All
times are integer microseconds, since 0.15 / 0.05 is 2.9999999999999996 in floating
point and would be charged one frame too little.

Beside it stands the other published model, a pipeline that delays every control and
skips no decision: `LatencyModel`.
"""

from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum
from numbers import Integral
from typing import Generic, TypeVar

from me2e_compress.base.errors import EvaluationError

DT_US = 50_000  # step of the benchmark's simulators: 20 Hz

T = TypeVar("T")


class LatencyModel(StrEnum):
    """What a latency does to the controls; results under different ones are apart."""

    DROP = "drop"  # decisions due during another are dropped (equation 4)
    # A decision every frame, each acting ceil(t / dt) frames later, in their order: the
    # "delayed control execution through FIFO action buffering" of Bench2Drive-Robust
    FIFO = "fifo"


def skipped_decisions(latency_us: int, dt_us: int = DT_US) -> int:
    """Return n of equation 4: how many decisions a latency skips."""
    # At a step of 50 ms everything below 100 ms gives n = 0: 10 ms and 90 ms drive
    # alike. A finer step tells them apart, and charges the same latency differently:
    # 120 ms delay by 100 ms at a step of 50 ms, by 120 ms at 10 ms. So results at
    # different steps must not be compared with each other.
    return max(0, _whole(latency_us) // dt_us - 1)


def delayed_frames(latency_us: int, dt_us: int = DT_US) -> int:
    """Return ceil(t / dt): how many frames later a control acts in a pipeline."""
    return -(-_whole(latency_us) // dt_us)


def _whole(latency_us: int) -> int:
    if not isinstance(latency_us, Integral) or latency_us < 0:
        raise EvaluationError(
            f"a latency source charged {latency_us!r}: it must be whole microseconds,"
            " 0 or more"
        )
    return latency_us


@dataclass
class ControlClock(Generic[T]):
    """Says in which frames a control acts and a decision is due; see `LatencyModel`."""

    in_force: T  # at first the control before any decision acts
    dt_us: int = DT_US  # step of the simulated world, microseconds
    model: LatencyModel = LatencyModel.DROP
    _frame: int = field(default=0, init=False)
    _due: int = field(default=0, init=False)
    _coming: deque[tuple[int, T]] = field(default_factory=deque, init=False)

    @property
    def decision_is_due(self) -> bool:
        """Whether the policy looks at this frame."""
        return self._frame == self._due

    def decide(self, control: T, latency_us: int) -> None:
        """Take the decision that is due, whose control took so long, at this frame."""
        if self.model is LatencyModel.FIFO:
            # Due at every frame, acting ceil(t / dt) frames later. A fast decision does
            # not overtake a slow one. As many run side by side as the delay has frames:
            # that says what a delay does, not what one computer can do.
            acts = self._frame + delayed_frames(latency_us, self.dt_us)
            self._due = self._frame + 1
        else:
            # With n = 0 the control acts at once. Else the one before stays for frames
            # k to k + n, whose observations are not used, and the new one acts from
            # frame k + n + 1 on, where the next decision is taken.
            skipped = skipped_decisions(latency_us, self.dt_us)
            self._due = self._frame + skipped + 1
            acts = self._due if skipped else self._frame
        self._coming.append((acts, control))

    def advance(self) -> T:
        """Return the control that acts in this frame, and go to the next."""
        while self._coming and self._coming[0][0] <= self._frame:
            _, self.in_force = self._coming.popleft()
        self._frame += 1
        return self.in_force
