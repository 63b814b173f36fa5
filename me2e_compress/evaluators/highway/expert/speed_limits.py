"""Speed limits of the expert: limits, bends, and stops at lights and signs."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from me2e_compress.evaluators.highway.expert.forecast import NOW_S, Forecast
from me2e_compress.simulator.plane_geometry import Floats, RoutePath
from me2e_compress.simulator.scene import Ego, Scene, Signal, SignalKind, SignalState
from me2e_compress.simulator.world import Phase

LATERAL_MPS2 = 2.2
"""Lateral acceleration in bends; the comfort bound of nuPlan is 4.89."""
EASE_MPS2 = 1.8
"""Braking ahead of a bend or a lower limit."""
SLOWEST_MPS = 2.5
"""Lowest speed that a bend demands."""


def ceiling(path: RoutePath) -> Floats:
    """Return [N] the highest speed (m/s) at every metre of a route without traffic."""
    window = np.full(5, 0.2)
    # curvature, averaged over 5 m
    bends = np.convolve(np.pad(np.abs(path.curvature), 2, mode="edge"), window, "valid")
    in_bend = np.sqrt(LATERAL_MPS2 / np.maximum(bends, 1e-4))
    top = np.minimum(path.speed_limits_mps, np.maximum(in_bend, SLOWEST_MPS))
    # brake in time for lower limits ahead
    for i in range(len(top) - 2, -1, -1):
        top[i] = min(top[i], np.sqrt(top[i + 1] ** 2 + 2 * EASE_MPS2))
    return top


STANDING_MPS = 0.08
"""Below this the ego has stopped; Bench2Drive asks for less than 0.1 m/s."""
BEFORE_LINE_M = 1.0
"""Room left between the front bumper and the line."""
SERVED_WITHIN_M = 4.0
"""A stop counts if the bumper is at most this far from the line."""
YELLOW_MPS2 = 3.0
"""A yellow light is obeyed if braking no harder than this stops in time."""
GIVE_WAY_S = 2.4
"""No priority traffic is met within this time after crossing a give-way line."""
CONFLICT_M, MEETING_M = 30.0, 2.0
"""Range behind the line, and beside the route, of priority traffic."""
GIVE_WAY_MPS = 5.0
"""Speed at a give-way line: slow enough to stop for priority traffic."""


@dataclass(frozen=True)
class Stop:
    """Arc lengths where the ego's centre must stop, or slow to `GIVE_WAY_MPS`, if any.

    ``served`` are the stop signs at which it has stopped.
    """

    line_m: float | None
    slow_m: float | None
    served: frozenset[int]


def obey(
    scene: Scene,
    phases: Iterable[Phase],
    seen: Forecast,
    ego_s_m: float,
    served: frozenset[int],
) -> Stop:
    """Return where the signals ahead on the route make the ego stop or slow down."""
    ego, lines, slow = scene.ego, list[float](), list[float]()
    # signals on the route whose line is still ahead
    line_of = {phase.signal_id: phase.line_s for phase in phases}
    for signal in scene.signals:
        line = line_of.get(signal.id)
        if line is None:
            continue
        gap = line - ego.length / 2 - ego_s_m
        if gap < 0:
            continue
        # a stop sign is served once the ego has stopped near its line
        if signal.kind is SignalKind.STOP_SIGN and gap <= SERVED_WITHIN_M:
            served = served | {signal.id} if _stands(ego) else served
        # a give-way line slows the ego, and stops it for traffic
        if signal.kind is SignalKind.GIVE_WAY:
            slow.append(line - ego.length / 2)
            if must_give_way(seen, line, _arrival(gap, ego.speed_mps)):
                lines.append(line - ego.length / 2 - min(BEFORE_LINE_M, gap))
        if _closed(signal, gap, ego.speed_mps, served):
            lines.append(line - ego.length / 2 - min(BEFORE_LINE_M, gap))
    return Stop(min(lines, default=None), min(slow, default=None), served)


def slowed(top: Floats, stop: Stop) -> Floats:
    """Return the ceiling lowered before a give-way line, if there is one."""
    if stop.slow_m is None:
        return top
    before = np.maximum(stop.slow_m - np.arange(len(top)), 0.0)
    slow = np.sqrt(GIVE_WAY_MPS**2 + 2 * EASE_MPS2 * before)
    past = np.arange(len(top)) > stop.slow_m
    return np.where(past, top, np.minimum(top, slow))


def must_give_way(seen: Forecast, line_m: float, crossing_s: float) -> bool:
    """Return whether priority traffic meets the route when the ego crosses a line."""
    in_reach = (seen.along_m > line_m) & (seen.along_m < line_m + CONFLICT_M)
    meets = in_reach & (np.abs(seen.lateral_m) < MEETING_M)
    meets &= (seen.speed_mps[:, :1] > 0.5) & ~seen.walks[:, None]
    first = np.argmax(meets, axis=1)
    leads = meets[:, 0] & (np.cos(seen.away[:, 0]) > 0.8)
    due = NOW_S[first] - crossing_s
    soon = (due > -0.5 - GIVE_WAY_S / 2) & (due < GIVE_WAY_S)
    return bool(np.any(meets.any(axis=1) & ~leads & soon))


def _arrival(gap_m: float, speed: float) -> float:
    """Return when the front is at a line, from a speed or from rest at 2 m/s2."""
    return float(min(gap_m / max(speed, 0.1), np.sqrt(gap_m)))


def _stands(ego: Ego) -> bool:
    return ego.speed_mps < STANDING_MPS


def _closed(signal: Signal, gap_m: float, speed: float, served: frozenset[int]) -> bool:
    if signal.kind is SignalKind.STOP_SIGN:
        return signal.id not in served
    if signal.state is SignalState.YELLOW:
        return speed**2 / (2 * max(gap_m, 0.1)) < YELLOW_MPS2
    return signal.state is SignalState.RED
