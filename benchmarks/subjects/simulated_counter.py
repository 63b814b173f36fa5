"""A counter of energy as GPUs have it, simulated over many windows at once.

Its value moves every step; what it adds is what it saw in a part of that step, times
the whole step, times noise (Yang, Adamek and Armour, Part-time Power Measurements, SC
2024: A100 and H100 look for 25 ms of 100 ms).
"""

from dataclasses import dataclass, replace

import numpy as np

from me2e_compress.runtime.energy.energy_counter import EnergySchedule
from me2e_compress.runtime.energy.energy_result import Window

Floats = np.ndarray[tuple[int, ...], np.dtype[np.float64]]

LEAD_S = 0.5
"""Frames before a window and behind it, seconds: the counter lags."""


@dataclass(frozen=True)
class Load:
    """A model at work, as its device's power shows it.

    Attributes:
        frame_s: seconds of a frame.
        jitter: standard deviation of a frame's length, as a share of it.
        busy: share of a frame at full power.
        busy_w: full power, watts.
        rest_w: power in the rest of a frame.
        spread: standard deviation of a frame's full power, as a share of it.
        burst_every: every so many frames, on average, one is a burst; 0: none.
        burst: of it, its full power over the usual.
        drift: share by which power rises while the chip warms up.
        drift_s: time constant of that.
    """

    frame_s: float
    jitter: float = 0.01
    busy: float = 0.7
    busy_w: float = 300.0
    rest_w: float = 120.0
    spread: float = 0.05
    burst_every: int = 0
    burst: float = 1.5
    drift: float = 0.03
    drift_s: float = 60.0

    def lasting(self, frame_s: float) -> "Load":
        """Return the same power with frames of so many seconds."""
        return replace(self, frame_s=frame_s)

    def mean_j(self) -> float:
        """Return the joules of a frame on average, on a cold chip."""
        burst = 1 + (self.burst - 1) / self.burst_every if self.burst_every else 1.0
        busy, rest = self.busy * self.busy_w * burst, (1 - self.busy) * self.rest_w
        return self.frame_s * (busy + rest)


@dataclass(frozen=True)
class Counter:
    """What reads the power.

    Attributes:
        step_s: from one value to the next.
        sensed: share of a step in which it looks.
        noise: standard deviation of what it sees, as a share of it.
        unit_j: of its value.
        range_j: where it wraps around; None: never.
    """

    step_s: float = 0.1
    sensed: float = 0.25
    noise: float = 0.02
    unit_j: float = 1e-3
    range_j: float | None = None


@dataclass(frozen=True)
class Simulated:
    """Windows of measurements, a row each.

    Attributes:
        windows: of every measurement.
        taken_j: joules a frame that its frames took.
        mean_j: joules a frame that such frames take on average, at that warmth.
    """

    windows: list[list[Window]]
    taken_j: Floats
    mean_j: Floats


def simulate(
    load: Load,
    counter: Counter,
    random: np.random.Generator,
    *,
    measurements: int,
    schedule: EnergySchedule,
) -> Simulated:
    """Simulate measurements of one model beside another that takes as long.

    Args:
        load: what runs.
        counter: what reads.
        random: draws everything.
        measurements: how many.
        schedule: of their windows.
    """
    windows, frames = schedule.windows, schedule.frames(load.frame_s)
    lead = int(np.ceil(LEAD_S / load.frame_s))
    shape = (measurements * windows, lead + frames + lead)
    span = frames * load.frame_s + schedule.lead_in_s
    begun = 2 * span * np.tile(np.arange(windows), measurements)
    warmth = -np.expm1(-(schedule.warm_up_s + begun) / load.drift_s)
    warm = 1 + load.drift * warmth[:, None]

    length = load.frame_s * (1 + load.jitter * random.standard_normal(shape))
    full = 1 + load.spread * random.standard_normal(shape)
    if load.burst_every:
        full *= np.where(random.random(shape) < 1 / load.burst_every, load.burst, 1.0)
    seconds = [length * load.busy, length * (1 - load.busy)]
    power = [load.busy_w * full * warm, load.rest_w * warm]
    parts_s = np.stack(seconds, -1)
    watts = np.stack([np.broadcast_to(each, shape) for each in power], -1)
    joules = parts_s * watts

    inside = slice(lead, lead + frames)
    taken = joules[:, inside].sum((1, 2)) / frames
    mean = load.mean_j() * warm[:, 0]
    times, energy = _from_zero(parts_s), _from_zero(joules)
    begin, end = times[:, 2 * lead], times[:, 2 * (lead + frames)]
    moved = _moved(counter, random, times, energy, begin, end)
    found = [
        Window(start, start + each, frames, counted)
        for start, each, counted in zip(begun, end - begin, moved, strict=True)
    ]
    return Simulated(
        [found[at : at + windows] for at in range(0, len(found), windows)],
        taken.reshape(-1, windows).mean(1),
        mean.reshape(-1, windows).mean(1),
    )


def _moved(
    counter: Counter,
    random: np.random.Generator,
    times: Floats,
    energy: Floats,
    begin: Floats,
    end: Floats,
) -> Floats:
    """Return by how much the counter moves from the begin of each row to its end."""
    step = counter.step_s
    first = random.uniform(0, step, len(begin)) + step
    ticks = first[:, None] + step * np.arange(int((times[:, -1].max() - step) // step))
    looked = step * counter.sensed
    seen = _at(ticks, times, energy) - _at(ticks - looked, times, energy)
    seen *= (1 + counter.noise * random.standard_normal(seen.shape)) / counter.sensed
    inside = (ticks > begin[:, None]) & (ticks <= end[:, None])
    before = random.uniform(0, counter.range_j or 1e6, len(begin))
    after = before + (seen * inside).sum(1)
    if counter.range_j is not None:
        after %= counter.range_j
    moved = (after // counter.unit_j - before // counter.unit_j) * counter.unit_j
    return np.asarray(moved if counter.range_j is None else moved % counter.range_j)


def _from_zero(parts: Floats) -> Floats:
    """Add up the parts of frames, row by row, from 0."""
    rows = parts.reshape(len(parts), -1)
    return np.asarray(np.cumsum(np.pad(rows, ((0, 0), (1, 0))), 1))


def _at(wanted: Floats, times: Floats, energy: Floats) -> Floats:
    """Interpolate every row at its own times."""
    apart = np.arange(len(times))[:, None] * (times[:, -1].max() + wanted.max() + 1)
    flat = np.interp((wanted + apart).ravel(), (times + apart).ravel(), energy.ravel())
    return np.asarray(flat).reshape(wanted.shape)
