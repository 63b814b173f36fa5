"""Summarize the windows of a counter as an energy result."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from me2e_compress.runtime.energy.energy_result import EnergyResult
from me2e_compress.runtime.energy.estimate import Window, estimate
from me2e_compress.runtime.energy.reader import DeviceState


@dataclass(frozen=True)
class CountedBy:
    """Description of the counter, copied into the result."""

    counter: str
    device: str
    scope: str
    step_s: float


def summarise(
    windows: Sequence[Window],
    by: CountedBy,
    idle_w: float | None,
    *,
    states: Sequence[DeviceState] = (),
    power_j_per_frame: float | None = None,
    warnings: tuple[str, ...] = (),
) -> EnergyResult:
    """Return the energy result of one model.

    ``idle_w`` is None where the idle device was not measured; ``states`` are those
    before and after each window.
    """
    found = estimate(windows, by.step_s, idle_w)
    # Pauses between frames are not part of a frame's time.
    frames = sum(each.frames for each in windows)
    frame_s = sum(each.taken_s - each.paused_s for each in windows) / frames
    # Not every device reports temperatures or clocks.
    warmth = [e.temperature_c for e in states if e.temperature_c is not None]
    throttled = dict.fromkeys(reason for each in states for reason in each.throttled)
    return EnergyResult(
        joules=sum(each.joules for each in windows),
        frames=frames,
        j_per_frame=found.j_per_frame,
        net_j_per_frame=None
        if idle_w is None
        else found.j_per_frame - idle_w * frame_s,
        low=found.low,
        high=found.high,
        windows=len(windows),
        window_s=float(np.mean([each.taken_s for each in windows])),
        counter=by.counter,
        counter_step_s=by.step_s,
        idle_w=idle_w,
        temperature=(warmth[0], warmth[-1]) if warmth else None,
        clocks=_clocks(states),
        throttled=tuple(throttled),
        device=by.device,
        scope=by.scope,
        window_j_per_frame=tuple(each.joules / each.frames for each in windows),
        power_j_per_frame=power_j_per_frame,
        warnings=warnings,
    )


def _clocks(states: Sequence[DeviceState]) -> dict[str, tuple[float, float]]:
    """Return the lowest and highest MHz of each clock."""
    seen: dict[str, list[float]] = {}
    for state in states:
        for name, mhz in state.clocks_mhz.items():
            seen.setdefault(name, []).append(mhz)
    return {name: (min(each), max(each)) for name, each in seen.items()}
