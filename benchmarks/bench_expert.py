"""How well the privileged expert drives, how fast it plans, and what latency does.

    python benchmarks/bench_expert.py --seeds 5 --workers 2
    python benchmarks/bench_expert.py --latencies 0.05,0.15,0.25,0.45,0.85 --workers 2

Routes are fresh and ungated: every type with seeds that no manifest has seen. With a
latency, equation 4 holds each control; 0 s is the controller's gate. Planning is
measured in processor time, the world's account of its actors included.
"""

import argparse
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

from me2e_compress.driving.realtime import HeldControl
from me2e_compress.evaluators.highway.controller import AnchoredPlan
from me2e_compress.evaluators.highway.expert.expert_policy import Memory, decide
from me2e_compress.evaluators.highway.expert.speed_limits import ceiling
from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.scenarios.catalogue import SCENARIO_ABILITIES
from me2e_compress.simulator.scene import INFRACTIONS, Control, EventKind
from me2e_compress.simulator.world import EndReason, World

FIRST_SEED = 900_000
TIME_LIMIT_S = 90.0


@dataclass(frozen=True)
class Drive:
    route: Route
    verdict: str
    seconds: float
    plans: int
    planning_s: float
    furthest_off_m: float

    @property
    def solved(self) -> bool:
        return self.verdict == "solved"


def drive(job: tuple[Route, float]) -> Drive:
    route, latency_s = job
    world, memory = World(route), Memory()
    top, held = ceiling(world.path), HeldControl(Control(0.0, 0.0))
    latency_us = round(latency_s * 1e6)
    planning, plans, off = 0.0, 0, 0.0
    coming: AnchoredPlan | None = None
    while not world.done and world.time_us < TIME_LIMIT_S * 1e6:
        if held.decision_is_due:
            scene = world.scene()
            begin = time.process_time()
            known = world.privileged()
            decision = decide(scene, known, world.path, top, memory)
            planning, plans = planning + time.process_time() - begin, plans + 1
            memory = decision.memory
            coming = AnchoredPlan.of(decision.waypoints, scene.ego, world.time_us)
            control = coming.control(scene.ego, world.time_us)
            held.decide(control, latency_us)
        world.step(held.advance())
        off = max(off, world.outside_m)
    return Drive(route, _verdict(world), world.time_us / 1e6, plans, planning, off)


def _verdict(world: World) -> str:
    kinds = [event.kind for event in world.events]
    wrong = [str(kind) for kind in dict.fromkeys(kinds) if kind in INFRACTIONS]
    if EventKind.ACTOR_COLLISION in kinds:
        wrong.append("(actors crash)")
    if world.reason is None:
        wrong.append(f"late at {world.progress_m:.0f} m")
    elif world.reason is EndReason.GOAL and not wrong:
        return "solved"
    return " ".join(wrong)


def fresh_routes(seeds: int, first_seed: int, types: Sequence[str]) -> list[Route]:
    return [
        Route(f"{name}-{seed}", name, SCENARIO_ABILITIES[name][0], seed)
        for name in types
        for seed in range(first_seed, first_seed + seeds)
    ]


def report(drives: Sequence[Drive], details: bool) -> None:
    by_ability = defaultdict[str, list[Drive]](list)
    for one in drives:
        for ability in one.route.abilities:
            by_ability[ability].append(one)
    by_ability["all"] = list(drives)
    for ability, some in by_ability.items():
        solved = sum(one.solved for one in some)
        mean_s = sum(one.seconds for one in some) / len(some)
        share = 100 * solved / len(some)
        print(
            f"{ability:16s} {solved:4d}/{len(some):4d} {share:6.1f} % {mean_s:6.1f} s"
        )
    plans = sum(one.plans for one in drives)
    planning = sum(one.planning_s for one in drives)
    if planning > 0:
        print(f"{plans} plans, {plans / planning:.0f} plans/s, ", end="")
        print(f"{1e3 * planning / plans:.2f} ms each")
    if details:
        failed = [one for one in drives if not one.solved]
        for one in failed:
            print(f"  {one.route.id}: {one.verdict} after {one.seconds:.1f} s")
        print(dict(Counter(one.route.scenario for one in failed).most_common()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--types", default=",".join(SCENARIO_ABILITIES))
    parser.add_argument("--latencies", default="0")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--details", action="store_true")
    options = parser.parse_args()
    routes = fresh_routes(options.seeds, options.first_seed, options.types.split(","))
    spawn = get_context("spawn")
    with ProcessPoolExecutor(options.workers, mp_context=spawn) as pool:
        for latency in map(float, options.latencies.split(",")):
            jobs = [(route, latency) for route in routes]
            begin = time.perf_counter()
            drives = list(pool.map(drive, jobs, chunksize=2))
            wall = time.perf_counter() - begin
            print(f"\nt = {latency:g} s: {len(drives)} routes, {wall:.0f} s wall")
            report(drives, options.details)


if __name__ == "__main__":
    main()
