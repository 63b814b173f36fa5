"""Do the intervals of measured energy hold the truth? On simulated counters they must.

``python -m benchmarks.measure.energy`` simulates measurements of models of several
frame times and powers by counters that move every 100 ms and look at 25 ms of these,
and prints how often the 95 % interval holds the true joules, and how wide it is.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.subjects.simulated_counter import Counter, Load, simulate
from me2e_compress.runtime.energy.energy_counter import EnergySchedule
from me2e_compress.runtime.energy.energy_result import estimate

FRAMES_MS = (5, 10, 20, 25, 33, 40, 50, 70, 100, 101, 150, 200, 400)
LOADS = {
    "steady": Load(0.0, jitter=0.001),
    "bursts": Load(0.0, jitter=0.01, burst_every=10),
}
"""Powers that are tried with each frame time: frames alike, and every tenth a burst of
half as much again."""
COUNTER = Counter(range_j=65_536.0)
_LARGEST = 3_000_000
"""Numbers of one array: 24 MB."""


@dataclass(frozen=True)
class Held:
    """How intervals fared.

    Attributes:
        simulations: how many.
        taken: share that holds what the frames took.
        mean: share that holds what such frames take on average.
        width: median of their widths, as a share of the truth.
        error: root of the mean square of how far the middle is off, as a share.
    """

    simulations: int
    taken: float
    mean: float
    width: float
    error: float


def held(
    load: Load,
    counter: Counter,
    schedule: EnergySchedule,
    *,
    simulations: int,
    seed: int,
) -> Held:
    """Simulate measurements of one load and see what their intervals hold."""
    rows = list(_rows(load, counter, schedule, simulations, seed))
    low, middle, high, taken, mean = np.array(rows).T
    return Held(
        simulations,
        float(np.mean((low <= taken) & (taken <= high))),
        float(np.mean((low <= mean) & (mean <= high))),
        float(np.median((high - low) / taken)),
        float(np.sqrt(np.mean((middle / taken - 1) ** 2))),
    )


def _rows(
    load: Load,
    counter: Counter,
    schedule: EnergySchedule,
    simulations: int,
    seed: int,
) -> Iterator[tuple[float, ...]]:
    random = np.random.default_rng(seed)
    numbers = schedule.windows * schedule.frames(load.frame_s) * 3
    most = max(1, _LARGEST // numbers)
    for done in range(0, simulations, most):
        count = min(most, simulations - done)
        found = simulate(
            *(load, counter, random),
            measurements=count,
            schedule=schedule,
        )
        rows = zip(found.windows, found.taken_j, found.mean_j, strict=True)
        for windows, taken, mean in rows:
            j_per_frame, low, high = estimate(windows, counter.step_s)
            yield low, j_per_frame, high, taken, mean


def conditions(
    frames_ms: Sequence[float] = FRAMES_MS,
) -> Iterator[tuple[str, float, Load]]:
    """List the grid: name of the power, milliseconds of a frame, the load."""
    for name, load in LOADS.items():
        for frame_ms in frames_ms:
            yield name, frame_ms, load.lasting(frame_ms / 1e3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--simulations", type=int, default=2_000, help="a condition")
    parser.add_argument("--windows", type=int, default=EnergySchedule().windows)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    schedule = EnergySchedule(windows=given.windows)
    print(
        f"{given.simulations} simulations a condition, {given.windows} windows each of"
        f" {schedule.window_s:g} s and {schedule.window_frames} frames or more\n"
    )
    print(
        "| power | frame ms | holds what was taken | holds the mean | width | error |"
    )
    print("|---|---:|---:|---:|---:|---:|")
    found = list[Held]()
    for name, frame_ms, load in conditions():
        each = held(
            *(load, COUNTER, schedule),
            simulations=given.simulations,
            seed=given.seed,
        )
        found.append(each)
        print(
            f"| {name} | {frame_ms:g} | {each.taken:.1%} | {each.mean:.1%} |"
            f" {each.width:.2%} | {each.error:.2%} |",
            flush=True,
        )
    print(
        f"\nall: {np.mean([e.taken for e in found]):.1%} hold what was taken,"
        f" {np.mean([e.mean for e in found]):.1%} the mean;"
        f" median width {np.median([e.width for e in found]):.2%}"
    )


if __name__ == "__main__":
    main()
