"""Traffic lights and signs, and when the ego disobeys them."""

from collections.abc import Callable
from dataclasses import dataclass, field

from me2e_compress.simulator.scene import EventKind, Signal, SignalKind, SignalState
from me2e_compress.simulator.traffic.network import LANE_WIDTH_M, Pose

STOPPED_MPS = 0.1
"""Slower than this is stopped, as in CARLA's RunningStopTest."""
STOP_ZONE_M = (-1.0, 5.0)
"""Where a stop counts: metres from the front bumper to the line. CARLA looks for the
stop within 4 m of the sign."""
YIELD_GAP_S = 1.5
"""With a priority vehicle nearer than this to the conflict, the ego did not yield."""


@dataclass
class Regulator:
    """A light or sign at one stop line.

    Attributes:
        line: Centre of the stop line, heading of the traffic that must obey.
        line_s: Arc length (m) at which the ego's route crosses the line, if it does.
        state: Phase of a light.
        nearest_s: For a give-way sign: seconds until the next vehicle with priority
            reaches the conflict, infinity if there is none.
        conflict_s: For a give-way sign: arc length of the conflict on the route.
    """

    id: int
    kind: SignalKind
    line: Pose
    line_s: float | None
    state: SignalState | None = None
    width_m: float = LANE_WIDTH_M
    nearest_s: Callable[[], float] = field(default=lambda: float("inf"), repr=False)
    conflict_s: float = float("inf")
    _conflict_passed: bool = False
    _front_passed: bool = False
    _tail_passed: bool = False
    _entered_on_red: bool = False
    _stopped: bool = False

    def snapshot(self) -> Signal:
        """Return it as it is seen: the lamp is at the right end of the line."""
        left = self.line.moved(0.0, self.width_m / 2)
        right = self.line.moved(0.0, -self.width_m / 2)
        post = self.line.moved(0.5, -self.width_m / 2 - 0.8)
        ends = ((left.x, left.y), (right.x, right.y))
        return Signal(
            self.id, self.kind, post.x, post.y, self.line.heading, self.state, ends
        )

    def check(self, front_s: float, tail_s: float, speed: float) -> EventKind | None:
        """Return which rule the ego breaks now, between two arc lengths of its route.

        A red light is run if both the front and the tail of the ego cross the line
        on red (CARLA looks at the tail alone, which blames a car that entered on
        yellow). A stop sign is run if the ego did not come to rest before it; a
        give-way sign if the front enters the conflict less than `YIELD_GAP_S` before
        a vehicle with priority. Each is reported once.
        """
        # give way
        if front_s >= self.conflict_s and not self._conflict_passed:
            self._conflict_passed = True
            if self.nearest_s() < YIELD_GAP_S:
                return EventKind.GIVE_WAY
        if self.line_s is None or self._tail_passed:
            return None
        # what the ego does at the line
        low, high = STOP_ZONE_M
        if low <= self.line_s - front_s <= high and speed < STOPPED_MPS:
            self._stopped = True
        if front_s >= self.line_s and not self._front_passed:
            self._front_passed = True
            self._entered_on_red = self.state is SignalState.RED
        if tail_s < self.line_s:
            return None
        # judged once the tail is over the line
        self._tail_passed = True
        if self.kind is SignalKind.STOP_SIGN and not self._stopped:
            return EventKind.STOP_SIGN
        if self._entered_on_red and self.state is SignalState.RED:
            return EventKind.RED_LIGHT
        return None
