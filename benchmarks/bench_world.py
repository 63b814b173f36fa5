"""Milliseconds a step of the world takes, by the number of cars.

    python benchmarks/bench_world.py [--steps 400] [--repeats 3]

The cars drive by IDM in the lanes beside the ego; the fastest repeat counts.
"""

import argparse
import time
from collections.abc import Callable

from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.scenarios.layouts.streets import BEFORE_M, multilane
from me2e_compress.simulator.scene import Control
from me2e_compress.simulator.traffic.stage import Stage
from me2e_compress.simulator.world import World

CARS = (0, 5, 20, 50)


def traffic(cars: int) -> Callable[[Stage], None]:
    def build(stage: Stage) -> None:
        street = multilane(stage)
        for k in range(cars):
            lane, row = 2 * (k % 2), k // 2
            s = BEFORE_M - 20.0 + 10.0 * row
            stage.car(street.ahead(lane), s, 8.0, 9.0 + lane)

    return build


def milliseconds(cars: int, steps: int) -> float:
    route = Route("bench", "Accident", "Overtaking", 0, {"lanes": 3, "ego_lane": 1})
    world, ran = World(route, builder=traffic(cars)), 0
    begin = time.perf_counter()  # building the world is not timed
    while ran < steps and not world.done:
        gap = 0.2 * (8.0 - world.scene().ego.speed_mps)
        world.step(Control(gap, 0.0))
        ran += 1
    return (time.perf_counter() - begin) / ran * 1e3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=250)
    parser.add_argument("--repeats", type=int, default=3)
    given = parser.parse_args()
    print(f"{'cars':>5} {'ms/step':>8} {'steps/s':>8}")
    for cars in CARS:
        best = min(milliseconds(cars, given.steps) for _ in range(given.repeats))
        print(f"{cars:5d} {best:8.3f} {1e3 / best:8.0f}")


if __name__ == "__main__":
    main()
