"""Real-time synchronous simulation: the world waits, then charges for the wait.

Equation 4: a decision that took t costs n = max(0, int(t / dt) - 1) decisions. All
times are integer microseconds, since 0.15 / 0.05 is 2.9999999999999996 in floating
point and would be charged one frame too little.
"""

from dataclasses import dataclass, field
from typing import Generic, TypeVar

DT_US = 50_000
"""Step of the benchmark's simulators: 20 Hz."""

T = TypeVar("T")


def skipped_decisions(latency_us: int, dt_us: int = DT_US) -> int:
    """Return n of equation 4: how many decisions a latency skips.

    At the benchmark's step of 50 ms everything faster than 100 ms gives n = 0, so 10 ms
    and 90 ms drive alike. A finer step tells them apart; it also charges the same
    latency differently (int() drops the remainder of another step: 120 ms are n = 1 at
    50 ms, a delay of 100 ms, and n = 11 at 10 ms, a delay of 120 ms) and lets a fast
    policy decide more often than 20 times a second. Results at different steps must
    not be compared with each other.

    Args:
        latency_us: How long the inference took, microseconds.
        dt_us: Step of the simulated world, microseconds.
    """
    return max(0, latency_us // dt_us - 1)


@dataclass
class HeldControl(Generic[T]):
    """Decides in which frames a control acts and a decision is due.

    A decision taken at frame k that skips n = 0 decisions acts at once. With n > 0 the
    control in force before frame k stays for the frames k to k + n, whose observations
    are not used, and the new one acts from frame k + n + 1 on, where the next decision
    is taken.

    Args:
        in_force: The control before any decision acts.
        dt_us: Step of the simulated world, microseconds.
    """

    in_force: T
    dt_us: int = DT_US
    _frame: int = field(default=0, init=False)
    _due: int = field(default=0, init=False)
    _coming: T | None = field(default=None, init=False)

    @property
    def decision_is_due(self) -> bool:
        """Whether the policy looks at this frame."""
        return self._frame == self._due

    def decide(self, control: T, latency_us: int) -> None:
        """Take the decision that is due at this frame.

        Args:
            control: What follows from the plan for this frame's observation.
            latency_us: How long it took, microseconds.
        """
        # the last decision's control acts from this frame on
        if self._coming is not None:
            self.in_force = self._coming
        skipped = skipped_decisions(latency_us, self.dt_us)
        self._coming = control
        if not skipped:
            self.in_force = control
        # the next decision is due when this one's control acts
        self._due = self._frame + skipped + 1

    def advance(self) -> T:
        """Return the control that acts in this frame, and go to the next."""
        self._frame += 1
        return self.in_force
