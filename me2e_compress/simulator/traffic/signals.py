"""Traffic lights and signs, and when the ego disobeys them."""

from collections.abc import Callable, Sequence
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
    _tail_passed: bool = False
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

        A red light is run if the tail of the ego crosses the line on red, as in CARLA,
        which also blames a car that entered too late on yellow. A stop sign is run if
        the ego did not come to rest before it; a give-way sign if the front enters the
        conflict less than `YIELD_GAP_S` before a vehicle with priority. Each is
        reported once.
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
        if tail_s < self.line_s:
            return None
        # judged once the tail is over the line
        self._tail_passed = True
        if self.kind is SignalKind.STOP_SIGN and not self._stopped:
            return EventKind.STOP_SIGN
        if self.state is SignalState.RED:
            return EventKind.RED_LIGHT
        return None


YELLOW_S, ALL_RED_S = 3.0, 2.0
"""Yellow is 3 s in CARLA (its traffic lights' default) and at 50 km/h in most
countries; two seconds in which all have red clear a junction of 24 m at 12 m/s."""


@dataclass(frozen=True)
class SignalPlan:
    """Phases of two groups of lights in turn, from the clock alone.

    Each group is green, yellow for `YELLOW_S`, then all are red for `ALL_RED_S`.

    Attributes:
        groups: The lights of each group; nobody's standing changes them.
        green_s: How long each is green.
        offset_s: Where in its cycle the plan is as the route begins.
    """

    groups: tuple[Sequence[Regulator], Sequence[Regulator]]
    green_s: tuple[float, float]
    offset_s: float

    @property
    def cycle_s(self) -> float:
        """Seconds after which it repeats."""
        return sum(self.green_s) + 2 * (YELLOW_S + ALL_RED_S)

    def begins_s(self, group: int) -> float:
        """Return when a group turns green for the first time, 0 s or later."""
        start = group * (self.green_s[0] + YELLOW_S + ALL_RED_S)
        return (start - self.offset_s) % self.cycle_s

    def state(self, group: int, time_us: int) -> SignalState:
        """Return the phase of a group."""
        cycle_us = round(self.cycle_s * 1e6)
        since_us = (time_us - round(self.begins_s(group) * 1e6)) % cycle_us
        green_us = round(self.green_s[group] * 1e6)
        if since_us < green_us:
            return SignalState.GREEN
        yellow = since_us < green_us + round(YELLOW_S * 1e6)
        return SignalState.YELLOW if yellow else SignalState.RED

    def show(self, time_us: int) -> None:
        """Set every light."""
        for number, group in enumerate(self.groups):
            state = self.state(number, time_us)
            for light in group:
                light.state = state
