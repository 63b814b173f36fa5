"""Successive halving against driving the whole grid, on the same routes and seeds.

    python -m benchmarks.bench_search OUT [--routes 44] [--workers 2]

28 schemes of the driver that ships: feature extraction and prediction in float or int8,
times up to two of map, motion and occupancy removed. Says how many points of driving
score halving's choice lies below the best of all (its regret), and how many hours each
took. Everything stays in OUT, so a run that was stopped goes on; ``--skip-exhaustive``
runs the search alone. Hours of driving are those that the routes took, over the
workers; making and timing the models is told apart, of the run that did it.
"""

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

import numpy as np

from me2e_compress.display import Table, table
from me2e_compress.evaluators.highway.engine import LocalEngine
from me2e_compress.study.on_road import Limits, RoadSearchOptions
from me2e_compress.study.on_road.halving import Rung
from me2e_compress.study.on_road.road_drives import RoadDrives, make_drives
from me2e_compress.study.on_road.road_search import (
    BASELINE,
    CONDITION,
    ahead,
    climbed,
    planned,
    within,
)
from me2e_compress.workflows.budgets import joules_here
from me2e_compress.workflows.checks import model_path
from me2e_compress.workflows.frames import FramesOptions, record_frames
from me2e_compress.workflows.listener import Listener

FRAMES = 64
DEVICE_S = 0.43
"""Median of a decision of the float model on the device, as in the driver's studies."""
SHOWN = 8


def main() -> None:
    """Search, drive the whole grid, and print both."""
    asked = _arguments()
    out: Path = asked.out
    out.mkdir(parents=True, exist_ok=True)
    listener = Listener(_progress, print)
    frames = out / "frames"
    if not (frames / "scenes.json").is_file():
        record_frames("highway", frames, FramesOptions(FRAMES), listener)
    options = RoadSearchOptions(
        drives=out / "drives",
        limits=Limits(max_mb=1000.0),
        ablate="map,motion,occ",
        most_ablated=2,
        routes=asked.routes,
        latency="trace",
        baseline_median_s=DEVICE_S,
        first_rung=22,
    )
    engine = LocalEngine(asked.workers)
    study, grid = planned(model_path("highway"), frames, options)
    print(ahead(study, grid, options, engine), flush=True)
    began = time.monotonic()
    made = make_drives(study, options.drives, joules_here(), engine, listener)
    minutes = (time.monotonic() - began) / 60
    print(f"made, timed and weighed in {minutes:.1f} minutes (of this run)", flush=True)
    fitting = within(made, options)
    rungs = climbed(made, fitting, options, print)
    _say_search(made, rungs, asked.workers)
    if not asked.skip_exhaustive:
        _say_regret(made, fitting, rungs, asked.workers)


def _say_search(made: RoadDrives, rungs: Sequence[Rung], workers: int) -> None:
    seconds, driven = _seconds(made), set[tuple[str, str]]()
    for rung in rungs:
        routes = [each.id for each in made.study.routes[: rung.routes]]
        names = [each.name for each in rung.standings] + [BASELINE]
        driven |= {(_file(made, name), route) for name in names for route in routes}
    hours = sum(seconds.get(each, 0.0) for each in driven) / 3600 / workers
    winner = rungs[-1].standings[0].name
    found = made.difference(winner).driving_score
    print(
        f"halving: {len(rungs[0].standings)} schemes, {len(driven):,} routes,"
        f" {hours:.2f} hours on {workers} workers; {winner}: {found.value:+.2f} DS"
        f" beside float ({found.low:+.2f} to {found.high:+.2f})",
        flush=True,
    )


def _say_regret(
    made: RoadDrives, fitting: Sequence[str], rungs: Sequence[Rung], workers: int
) -> None:
    routes, stood = made.study.routes, dict[str, int]()
    for rung in rungs:
        stood |= {each.name: rung.routes for each in rung.standings}
    means = dict[str, float]()
    for done, name in enumerate(fitting):
        means[name] = fmean(made.differ(name, routes))
        print(f"{done + 1}/{len(fitting)} {name}: {means[name]:+.2f} DS", flush=True)
    order = sorted(means, key=lambda name: -means[name])
    winner = rungs[-1].standings[0].name
    seconds = sum(_seconds(made).values())
    print(_ranking(order, means, stood).markdown())
    regret = means[order[0]] - means[winner]
    others = np.array([made.differ(each, routes) for each in (order[0], winner)])
    spread = float((others[0] - others[1]).std() / np.sqrt(len(routes)))
    print(
        f"exhaustive: {len(fitting)} schemes, {(len(fitting) + 1) * len(routes):,}"
        f" routes, {seconds / 3600 / workers:.2f} hours on {workers} workers\n"
        f"regret of halving on these {len(routes)} routes: {regret:.2f} DS (standard"
        f" error of that difference {spread:.2f}); its choice is number"
        f" {order.index(winner) + 1} of {len(order)}"
    )


def _ranking(
    order: Sequence[str], means: dict[str, float], stood: dict[str, int]
) -> Table:
    rows = [
        (str(at + 1), name, f"{means[name]:+.2f}", str(stood[name]))
        for at, name in enumerate(order[:SHOWN])
    ]
    columns = ("", "scheme", "DS beside float", "routes in halving")
    return table("The best of the whole grid", columns, rows)


def _file(made: RoadDrives, name: str) -> str:
    return made.prepared[name].variant.name


def _seconds(made: RoadDrives) -> dict[tuple[str, str], float]:
    """Read what each route took, by scheme and route."""
    found = dict[tuple[str, str], float]()
    folder = made.setup.workspace.folder / "results"
    for log in sorted(folder.glob(f"*.{CONDITION}.log")):
        for line in log.read_text("utf-8").splitlines():
            row = json.loads(line)
            found[log.name.removesuffix(f".{CONDITION}.log"), row["route"]] = row[
                "seconds"
            ]
    return found


def _progress(stage: str, done: int, total: int, words: str) -> None:
    if done == total:
        print(f"  {stage}: {total} {words}", flush=True)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--routes", default="44", help="44, or all 220")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--skip-exhaustive", action="store_true")
    return parser.parse_args()


if __name__ == "__main__":
    main()
