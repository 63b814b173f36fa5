"""What the collision optimiser costs, and in which frames.

    python -m benchmarks.measure.host_stage --routes 6

The driver that ships drives with the stage; every decision's plan and occupancy are
kept. Then each solver works through those decisions, in turn with the other, so that a
noisy moment falls on both: thread CPU time, iterations, cells. The last table is a
straight line through the costs, which the latency source ``host-stage`` takes:
microseconds for a call, an iteration and a cell. Obstacle frames are those in which the
stage had cells to take into account.
"""

import argparse
import time
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from me2e_compress.driving.host_stage import CollisionOptimizer, HostWork
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.evaluators import Drive
from me2e_compress.evaluators.highway.runner import drive
from me2e_compress.metrics.route_scores import route_score
from me2e_compress.shipped.drivers import shipped_model
from me2e_compress.simulator.routes import load_routes, pick_routes

Floats = npt.NDArray[np.float64]
Outputs = Mapping[str, npt.NDArray[np.generic]]

REPEATS = 3
"""The shortest of so many is what a decision took."""


def recorded(routes: str) -> list[tuple[Floats, Outputs]]:
    """Drive the routes; return the plan and the occupancy of every decision."""
    asked = list[tuple[Floats, Outputs]]()
    plain = OnnxPolicy.open(shipped_model("highway"))

    class Recorder(CollisionOptimizer):
        """The stage, which keeps what it was given."""

        def work(self, plan: Floats, outputs: Outputs) -> HostWork:
            asked.append((plan, {self.output: outputs[self.output]}))
            return super().work(plan, outputs)

    policy = OnnxPolicy.open(shipped_model("highway"), stage=Recorder())
    for route in pick_routes(load_routes(), routes):
        scores = [
            route_score(drive(route, each, Drive())).composed
            for each in (plain, policy)
        ]
        print(f"{route.id}: driving score {scores[0]:.1f}, with it {scores[1]:.1f}")
    return asked


def timed(
    stages: Sequence[CollisionOptimizer], asked: Sequence[tuple[Floats, Outputs]]
) -> dict[str, Floats]:
    """Return by solver [N, 3]: microseconds, iterations, cells of every decision."""
    rows = dict[str, list[tuple[float, int, int]]]()
    in_turn = [*stages] * REPEATS
    for plan, outputs in asked:
        shortest, works = dict[str, float](), dict[str, HostWork]()
        for stage in in_turn:
            begun = time.thread_time_ns()
            works[stage.solver] = stage.work(plan, outputs)
            taken = (time.thread_time_ns() - begun) / 1e3
            shortest[stage.solver] = min(taken, shortest.get(stage.solver, taken))
        for solver, work in works.items():
            row = shortest[solver], work.iterations, work.cells
            rows.setdefault(solver, []).append(row)
    return {solver: np.array(found) for solver, found in rows.items()}


def main() -> None:
    """Print what was driven, what each solver took, and the line through it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--routes", default="6", help="as evaluate takes them")
    asked = recorded(parser.parse_args().routes)
    stages = [CollisionOptimizer(solver=name) for name in ("SLSQP", "L-BFGS-B")]
    found = timed(stages, asked)
    print(f"\n{len(asked)} decisions; microseconds of CPU in this thread")
    print(f"{'solver':10} {'frames':>18} {'p50':>7} {'p99':>7} {'max':>7} iterations")
    for solver, rows in found.items():
        busy = rows[:, 1] > 0
        for name, part in (("with obstacles", rows[busy]), ("without", rows[~busy])):
            p50, p99, most = np.percentile(part[:, 0], (50, 99, 100))
            share = f"{len(part)} {name}"
            steps = f"{part[:, 1].mean():.1f}, at most {part[:, 1].max():.0f}"
            print(f"{solver:10} {share:>18} {p50:7.0f} {p99:7.0f} {most:7.0f} {steps}")
    print("\nThe line through the frames with obstacles, less those without:")
    for solver, rows in found.items():
        busy = rows[:, 1] > 0
        idle_us = np.median(rows[~busy, 0])
        design = np.column_stack([np.ones(busy.sum()), rows[busy, 1:]])
        call, iteration, cell = np.linalg.lstsq(design, rows[busy, 0] - idle_us)[0]
        print(
            f"{solver:10} per_call_us={call:.0f}, per_iteration_us={iteration:.0f},"
            f" per_cell_us={cell:.1f}"
        )


if __name__ == "__main__":
    main()
