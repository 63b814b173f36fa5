"""How much a set of routes lets happen, and how well it tells drivers apart.

    python -m benchmarks.bench_road --road 2 --variants 1 --types Accident,T_Junction
    python -m benchmarks.bench_road --routes routes.json
    python -m benchmarks.bench_road --compare float/ full/ float-4fps/

The first two look at proposals, or at a set: how many actors move within 80 m of the
ego as a route begins (the median over routes), what a step of the world takes, and at
how many of five speeds a blind driver and the scenario's others meet, by type; they
also count types whose light shows the ego red or yellow, and those with a sign. The
last compares results folders of one set: the share of routes with a driving score of
exactly 100, and how many routes do not end alike for all.
"""

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, median

from me2e_compress.evaluators.highway.blind import Blind
from me2e_compress.evaluators.highway.conditions import Conditions
from me2e_compress.evaluators.highway.generate import propose, seed_of
from me2e_compress.evaluators.highway.results import ResultsFolder
from me2e_compress.evaluators.highway.runner import Listeners, drive
from me2e_compress.metrics.driving_score import route_score
from me2e_compress.simulator.routes import Route, load_routes
from me2e_compress.simulator.scenarios.catalogue import SCENARIO_ABILITIES
from me2e_compress.simulator.scene import EventKind, Scene, SignalKind, SignalState
from me2e_compress.simulator.world import World

SPEEDS_MPS = (4.0, 6.0, 8.0, 10.0, 12.0)
NEAR_M, MOVING_MPS = 80.0, 0.3
AHEAD_M = 40.0
"""A light that is this near shows the ego its phase."""
SIGNS = (SignalKind.STOP_SIGN, SignalKind.GIVE_WAY)


@dataclass(frozen=True)
class BlindDrive:
    """What one blind drive of one route shows."""

    met: bool
    infraction: bool
    stopped_by_light: bool
    step_ms: float


def moving_near(scene: Scene) -> int:
    """Return how many actors move near the ego."""
    ego = scene.ego
    return sum(
        each.speed_mps > MOVING_MPS
        and math.hypot(each.x - ego.x, each.y - ego.y) < NEAR_M
        for each in scene.actors
    )


def blind_drive(route: Route, speed_mps: float) -> BlindDrive:
    """Drive a route blindly, and note what it meets."""
    shown, worlds = list[bool](), list[World]()

    def look(world: World) -> None:
        worlds.append(world)
        lines = {
            e.signal_id: e.line_s - world.ego_s for e in world.privileged(()).phases
        }
        shown.append(
            any(
                0.0 < lines.get(each.id, -1.0) < AHEAD_M
                and each.state in (SignalState.RED, SignalState.YELLOW)
                for each in world.scene().signals
            )
        )

    begun = time.process_time()
    episode = drive(route, Blind(speed_mps), Conditions(), Listeners(on_query=look))
    took = time.process_time() - begun
    kinds = [event.kind for event in worlds[-1].events]
    return BlindDrive(
        EventKind.TRIGGER in kinds,
        bool(episode.infractions),
        any(shown),
        1e3 * took / max(len(episode.frames), 1),
    )


def look_at(routes: Sequence[Route]) -> None:
    """Print the tables of some routes."""
    moving, frame_ms, lit, signed = list[int](), list[float](), set[str](), set[str]()
    print("scenario | moving | met at 4, 6, 8, 10, 12 m/s | infractions at these")
    print("---|---|---|---")
    for name in dict.fromkeys(route.scenario for route in routes):
        own = [route for route in routes if route.scenario == name]
        near, drives = list[int](), dict[float, list[BlindDrive]]()
        for route in own:
            scene = World(route).scene()
            near.append(moving_near(scene))
            signed |= {name for each in scene.signals if each.kind in SIGNS}
            for speed in SPEEDS_MPS:
                drives.setdefault(speed, []).append(blind_drive(route, speed))
        found = [each for several in drives.values() for each in several]
        met = " ".join(f"{fmean(e.met for e in drives[s]):.0%}" for s in SPEEDS_MPS)
        lit |= {name} if any(each.stopped_by_light for each in found) else set()
        failed = [fmean(e.infraction for e in drives[s]) for s in SPEEDS_MPS]
        words = " ".join(f"{share:.0%}" for share in failed)
        print(f"{name} | {median(near):g} | {met} | {words}", flush=True)
        moving += near
        frame_ms += [each.step_ms for each in found]
    print(f"\nmoving within 80 m as a route begins: median {median(moving):g}")
    print(f"a frame of a blind drive: median {median(frame_ms):.2f} ms of CPU time")
    print(f"types that show red or yellow: {len(lit)}; with a sign: {len(signed)}")


def compare(folders: Sequence[Path]) -> None:
    """Print how drives of one set differ."""
    scores = [
        {
            name: route_score(one).composed
            for name, one in ResultsFolder.open(path).episodes().items()
        }
        for path in folders
    ]
    for path, own in zip(folders, scores, strict=True):
        whole = fmean(score == 100.0 for score in own.values())
        print(f"{path}: {len(own)} routes, {whole:.1%} at exactly 100")
    shared = [name for name in scores[0] if all(name in own for own in scores)]
    unlike = [name for name in shared if len({own[name] for own in scores}) > 1]
    print(f"{len(unlike)} of {len(shared)} routes do not end alike for all")


def main() -> None:
    """Read what is looked at."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--routes", type=Path, help="a set; else proposals")
    parser.add_argument("--road", type=int, default=2)
    parser.add_argument("--variants", type=int, default=1, help="proposals of a type")
    parser.add_argument("--types", default=",".join(SCENARIO_ABILITIES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--compare", type=Path, nargs="+", help="results folders")
    given = parser.parse_args()
    if given.compare:
        compare(given.compare)
        return
    if given.routes:
        look_at(load_routes(given.routes))
        return
    look_at(
        [
            propose(name, seed_of(given.seed, name, k), f"{name}_{k}", given.road)
            for name in given.types.split(",")
            for k in range(given.variants)
        ]
    )


if __name__ == "__main__":
    main()
