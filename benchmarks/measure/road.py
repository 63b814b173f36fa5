"""How much a set of routes lets happen, and how well it tells drivers apart.

    python -m benchmarks.measure.road --workers 2
    python -m benchmarks.measure.road --routes routes.json
    python -m benchmarks.measure.road --fresh 1 --types Accident,T_Junction
    python -m benchmarks.measure.road --admission admission.json
    python -m benchmarks.measure.road --compare benchmarks/road_2/trained/*/routes.csv
        [--drives trained.four,minus-occ.four]

The first three look at the set that ships, another, or so many proposals of each type:
how many actors move within 80 m of the ego as a route begins (the median over routes),
and how often blind drivers of five speeds and the scenario's others meet, by type; they
also count types whose light shows a blind driver red or yellow, and those with a sign.
Blind drivers decide ten times a second. ``--admission`` takes what ``admit_routes``
printed, and counts the proposals that were refused, by reason. The last compares
kept drives of one set: the share of routes with a driving score of exactly 100, how
many routes do not end alike for all, and both by type.
"""

import argparse
import csv
import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, median
from typing import Self

from me2e_compress.driving.latency import FixedLatency
from me2e_compress.evaluators.contract import Drive
from me2e_compress.evaluators.highway.driven_frames import propose, seed_of
from me2e_compress.evaluators.highway.runner import Listeners, drive
from me2e_compress.metrics.measure import Estimate, mean_estimate
from me2e_compress.metrics.route_summary import RouteSummary
from me2e_compress.simulator.routes import (
    SCENARIO_ABILITIES,
    SHIPPED,
    Route,
    load_routes,
)
from me2e_compress.simulator.scene import EventKind, Scene, SignalKind, SignalState
from me2e_compress.simulator.world import World
from me2e_compress.study.drive_record import DriveRecord
from models.driver.expert.blind import Blind
from models.driver.expert.privileged import privileged
from models.processes import process_pool

NEAR_M, MOVING_MPS = 80.0, 0.3
AHEAD_M = 40.0
"""A light that is this near shows the ego its phase."""
WAIT = (SignalState.RED, SignalState.YELLOW)
SIGNS = (SignalKind.STOP_SIGN, SignalKind.GIVE_WAY)


@dataclass(frozen=True)
class BlindDrive:
    """What one blind drive of one route shows."""

    met: bool
    infraction: bool
    lit: bool


@dataclass(frozen=True)
class Look:
    """One route: who moves near its beginning, its signs, and the blind drives."""

    route: Route
    moving: int
    has_sign: bool
    drives: tuple[BlindDrive, ...]


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
    lit, worlds = list[bool](), list[World]()

    def look(world: World) -> None:
        worlds.append(world)
        ahead = [
            (e.line_s - world.ego_s, e.state) for e in privileged(world, ()).phases
        ]
        lit.append(any(0.0 < at < AHEAD_M and state in WAIT for at, state in ahead))

    episode = drive(
        route,
        Blind(speed_mps),
        Drive(FixedLatency(100_000)),
        Listeners(on_query=look),
    )
    kinds = [event.kind for event in worlds[-1].events]
    return BlindDrive(EventKind.TRIGGER in kinds, bool(episode.infractions), any(lit))


def look_at(route: Route, speeds: Sequence[float]) -> Look:
    """Look at one route."""
    scene = World(route).scene()
    drives = tuple(blind_drive(route, speed) for speed in speeds)
    has_sign = any(each.kind in SIGNS for each in scene.signals)
    return Look(route, moving_near(scene), has_sign, drives)


def show(
    routes: Sequence[Route], speeds: Sequence[float], variants: int, workers: int
) -> None:
    """Print the tables of some routes, of which so many of each type are driven."""
    count = Counter[str]()
    with process_pool(workers) as processes:
        waiting = []
        for route in routes:
            driven = speeds if count[route.scenario] < variants else ()
            waiting.append(processes.submit(look_at, route, driven))
            count[route.scenario] += 1
        looks = [each.result() for each in waiting]
    words = ", ".join(f"{speed:g}" for speed in speeds)
    print(f"type | moving | meets at {words} m/s | infractions at these")
    print("---|---|---|---")
    lit, signed = set[str](), set[str]()
    for name in dict.fromkeys(route.scenario for route in routes):
        own = [each for each in looks if each.route.scenario == name]
        lit |= {name for each in own for one in each.drives if one.lit}
        signed |= {name for each in own if each.has_sign}
        print(f"{name} | {median(e.moving for e in own):g} | {_shares(own)}")
    print(f"all | {median(e.moving for e in looks):g} | {_shares(looks)}")
    still = sum(each.moving == 0 for each in looks)
    print(f"\n{len(looks)} routes; nobody moves within 80 m as {still} begin")
    print(f"types that show a blind driver red or yellow: {len(lit)}")
    print(f"types with a stop or give-way sign: {len(signed)}")


def _shares(looks: Sequence[Look]) -> str:
    columns = list(zip(*(each.drives for each in looks if each.drives), strict=True))
    met = " ".join(f"{fmean(e.met for e in drives):.0%}" for drives in columns)
    failed = " ".join(
        f"{fmean(e.infraction for e in drives):.0%}" for drives in columns
    )
    return f"{met} | {failed}"


REASONS = {
    "the blind driver": "blind drivers solve it",
    "two actors collide": "two others collide",
    "with other traffic": "the expert fails with other traffic",
    "the scenario's event": "the expert never meets its conflict",
    "the expert": "the expert fails",
}


def admission(path: Path) -> None:
    """Print why proposals were refused."""
    record = json.loads(path.read_text())
    why = [each for one in record["scenarios"] for each in one["refusals"]]
    counts = Counter(
        next(words for start, words in REASONS.items() if each.startswith(start))
        for each in why
    )
    tried = record["tried"]
    print(f"{len(why)} of {tried} proposals were refused ({len(why) / tried:.0%})")
    for words, count in counts.most_common():
        print(f"{words} | {count}")


@dataclass(frozen=True)
class RouteScores:
    """What a drive got on one route, in percent, and how it ended, with infractions.

    Room kept is None if unknown.
    """

    end: str
    score: float
    success: float
    room: float | None

    @classmethod
    def of(cls, route: RouteSummary) -> Self:
        """Take a record's route."""
        end = " ".join([route.ending, *(kind for kind, _ in route.moments)])
        success = 100.0 * route.succeeded
        return cls(end, route.driving_score, success, route.room_kept)


def drives_of(files: Sequence[Path]) -> dict[str, dict[str, RouteScores]]:
    """Read drives by ``SCHEME.CONDITION`` and route: ``routes.csv``, or records."""
    found = dict[str, dict[str, RouteScores]]()
    for path in files:
        if path.suffix == ".jsonl":
            record = DriveRecord.load(path)
            found[record.name] = {
                each.route: RouteScores.of(each) for each in record.routes
            }
            continue
        with path.open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                room = row.get("room_kept_percent")
                found.setdefault(f"{row['scheme']}.{row['condition']}", {})[
                    row["route"]
                ] = RouteScores(
                    f"{row['ending']} {row['infractions']}".strip(),
                    float(row["driving_score_percent"]),
                    100.0 * int(row["succeeded"]),
                    float(room) if room else None,
                )
    return found


def means_of(own: Mapping[str, RouteScores]) -> dict[str, Estimate]:
    """Return means over routes with both intervals; without room where unknown."""
    found = dict[str, Estimate]()
    for column in ("score", "success", "room"):
        every = {name: getattr(each, column) for name, each in own.items()}
        known = {name: value for name, value in every.items() if value is not None}
        if known:
            types = [type_of(name) for name in known]
            values = [*known.values()]
            found[column] = mean_estimate(values, types, "%", bounds=(0.0, 100.0))
    return found


def compare(files: Sequence[Path], chosen: Sequence[str]) -> None:
    """Print how drives of one set differ, and where; of some, or all that are kept."""
    drives = drives_of(files)
    drives = {name: drives[name] for name in chosen or drives}
    for name, own in drives.items():
        whole = fmean(each.score == 100.0 for each in own.values())
        print(f"{name}: {len(own)} routes, {whole:.1%} at exactly 100")
        for column, found in means_of(own).items():
            here = f"{found.low:.1f} to {found.high:.1f}"
            anew = f"{found.anew_low:.1f} to {found.anew_high:.1f}"
            print(f"  {column} {found.value:.1f} ({here}; types anew {anew})")
    every = dict.fromkeys(name for own in drives.values() for name in own)
    by_route = {n: [own[n] for own in drives.values() if n in own] for n in every}
    unlike = {n for n, each in by_route.items() if len({one.end for one in each}) > 1}
    scored = sum(len({one.score for one in each}) > 1 for each in by_route.values())
    print(
        f"{len(unlike)} of {len(every)} routes do not end alike for all who drove them,"
        f" by ending and infractions; {scored} have other scores\n"
    )
    print(f"type | {' | '.join(drives)} | not alike")
    print("---|" * (1 + len(drives)) + "---")
    for kind in dict.fromkeys(map(type_of, every)):
        names = [each for each in every if type_of(each) == kind]
        scores = ([o[n].score for n in names if n in o] for o in drives.values())
        told = " | ".join(f"{fmean(each):.1f}" if each else "-" for each in scores)
        parted = len(unlike.intersection(names))
        print(f"{kind} | {told} | {parted} of {len(names)}")


def type_of(route: str) -> str:
    """Return the type of a route: ``Accident_R2_0``."""
    return route.rpartition("_")[0].removesuffix("_R2")


def main() -> None:
    """Read what is looked at."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--routes", type=Path, help="another set than what ships")
    parser.add_argument("--fresh", type=int, help="proposals of each type, no set")
    parser.add_argument("--types", default=",".join(SCENARIO_ABILITIES))
    parser.add_argument("--speeds", default="4,6,8,10,12", help="of blind drivers")
    parser.add_argument("--variants", type=int, default=5, help="driven of each type")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--admission", type=Path, help="what admit_routes printed")
    parser.add_argument(
        "--compare", type=Path, nargs="+", help="routes.csv, or records"
    )
    parser.add_argument("--drives", default="", help="SCHEME.CONDITION; all")
    given = parser.parse_args()
    speeds = [float(each) for each in given.speeds.split(",")]
    if given.compare:
        compare(given.compare, [*filter(None, given.drives.split(","))])
    elif given.admission:
        admission(given.admission)
    elif given.fresh:
        proposals = [
            propose(name, seed_of(given.seed, name, k), f"{name}_{k}")
            for name in given.types.split(",")
            for k in range(given.fresh)
        ]
        show(proposals, speeds, given.variants, given.workers)
    else:
        there = load_routes(given.routes or SHIPPED)
        types = given.types.split(",")
        picked = [each for each in there if each.scenario in types]
        show(picked, speeds, given.variants, given.workers)


if __name__ == "__main__":
    main()
