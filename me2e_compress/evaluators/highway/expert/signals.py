"""Where lights and signs make the expert stop."""

from collections.abc import Iterable
from dataclasses import dataclass

from me2e_compress.evaluators.highway.scene import (
    Ego,
    Scene,
    Signal,
    SignalKind,
    SignalState,
)
from me2e_compress.evaluators.highway.world.privileged import Phase

STANDING_MPS = 0.08
"""Slower than this has stopped; Bench2Drive asks for less than 0.1 m/s."""
BEFORE_LINE_M = 1.0
"""Room left between the front bumper and the line."""
SERVED_WITHIN_M = 4.0
"""A stop counts if the bumper is at most this far from the line."""
YELLOW_MPS2 = 3.0
"""A yellow light is obeyed if braking no harder than this stops in time."""
GIVE_WAY_MPS = 5.0
"""Speed at a give-way line: slow enough to stop for who has priority."""


@dataclass(frozen=True)
class Stop:
    """What the signals ask for.

    Args:
        line_m: Arc length that the ego's centre must not pass now, or None.
        slow_m: Arc length at which only `GIVE_WAY_MPS` is allowed, or None.
        served: Stop signs at which the ego has stopped.
    """

    line_m: float | None
    slow_m: float | None
    served: frozenset[int]


def obey(
    scene: Scene, phases: Iterable[Phase], ego_s_m: float, served: frozenset[int]
) -> Stop:
    """Look at every signal ahead on the route.

    Args:
        scene: What there is.
        phases: Which signals are on the route, and where.
        ego_s_m: Arc length of the ego.
        served: Stop signs already obeyed.
    """
    ego, lines, slow = scene.ego, list[float](), list[float]()
    line_of = {phase.signal_id: phase.line_s for phase in phases}
    for signal in scene.signals:
        line = line_of.get(signal.id)
        if line is None:
            continue
        gap = line - ego.length / 2 - ego_s_m
        if gap < 0:
            continue
        if signal.kind is SignalKind.STOP_SIGN and gap <= SERVED_WITHIN_M:
            served = served | {signal.id} if _stands(ego) else served
        if signal.kind is SignalKind.GIVE_WAY:
            slow.append(line - ego.length / 2)
        if _closed(signal, gap, ego.speed_mps, served):
            lines.append(line - ego.length / 2 - min(BEFORE_LINE_M, gap))
    return Stop(min(lines, default=None), min(slow, default=None), served)


def _stands(ego: Ego) -> bool:
    return ego.speed_mps < STANDING_MPS


def _closed(signal: Signal, gap_m: float, speed: float, served: frozenset[int]) -> bool:
    if signal.kind is SignalKind.STOP_SIGN:
        return signal.id not in served
    if signal.state is SignalState.YELLOW:
        return speed**2 / (2 * max(gap_m, 0.1)) < YELLOW_MPS2
    return signal.state is SignalState.RED
