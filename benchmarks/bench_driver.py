"""The driver that ships, in figures: ablated, compressed, slowed down.

    python -m benchmarks.bench_driver OUT [--only NAME ...] [--workers N] [--routes N]
                                          [--target tensorrt|onnxruntime]
                                          [--rules safe|paper]

Studies, one after the other: baselines (expert, blind, the driver), ablation (each
module away), pairs (two away), schemes (float to int8, at no latency and at each
model's own under one device scale), scales (float and int8 on devices that are faster
and slower), latency (fewer decisions a second), determinism (the driver twice, compared
byte by byte). They share OUT, so what one has driven the
next does not drive again, and a run that was stopped goes on: every route is written
when it is driven (OUT/results/). Each study writes OUT/<study>/tables.md, routes.csv,
study.json and report.html; the tables of all are in OUT/tables.md.
"""

import argparse
import sys
import time
from collections.abc import Callable, Mapping
from itertools import combinations
from pathlib import Path

from benchmarks.driver_records import (
    among_conditions,
    among_variants,
    losers,
    routes_csv,
)
from benchmarks.driver_studies import (
    IDEAL,
    MODULES,
    SLOWER,
    STUDIES,
    Bench,
    determinism,
)
from me2e_compress.errors import Me2eError
from me2e_compress.evaluators.highway.engine import LocalEngine
from me2e_compress.runtime.atomic import write_bytes
from me2e_compress.simulator.routes import load_routes, pick_routes
from me2e_compress.study import Listener, run_study
from me2e_compress.study.workspace import MARKDOWN, Workspace
from me2e_compress.study.write import write_study
from me2e_compress.workflows.checks import model_path
from me2e_compress.workflows.frames import FramesOptions, record_frames

DRIVER = "highway"
CALIBRATION = (256, 0)
"""Frames that passes calibrate on, and their seed."""
HELD_OUT = (64, 1)
COMMAND = ("python", "-m", "benchmarks.bench_driver")


def same_bytes(bench: Bench) -> str:
    """Hold the two drives of the same model against each other, file by file."""
    workspace = Workspace(bench.out)
    first, again = (
        {
            path.name: path.read_bytes()
            for path in (workspace.results(variant, IDEAL) / "routes").glob("*.json")
        }
        for variant in determinism(bench).variants
    )
    equal = sum(first[name] == again.get(name) for name in first)
    size = sum(map(len, first.values()))
    return f"{equal} of {len(first)} files equal to the byte ({size:,} bytes).\n"


def told() -> Listener:
    """Say every half minute how far a study is."""
    begun, last = time.monotonic(), -60.0

    def on_progress(stage: str, done: int, total: int, words: str) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last > 30.0 or done == total:
            minutes = (now - begun) / 60
            print(f"{minutes:6.1f} min  {stage}: {done}/{total}  {words}", flush=True)
            last = now

    return Listener(on_progress, lambda line: print(f"warning: {line}", flush=True))


def slowed(bench: Bench) -> str:
    """Hold fewer decisions a second against no latency, and against the most."""
    conditions, place = (IDEAL, *SLOWER), Workspace(bench.out)
    tables = (
        among_conditions(place, bench.float, conditions, to) for to in conditions[:2]
    )
    return "\n".join(table.markdown() for table in tables)


def one_more(bench: Bench) -> str:
    """Hold what drives without two modules against what drives without one of them."""
    couples = [
        (bench.without(*pair), bench.without(name))
        for pair in combinations(MODULES, 2)
        for name in pair
    ]
    return among_variants(Workspace(bench.out), couples, IDEAL).markdown()


BESIDES: Mapping[str, Callable[[Bench], str]] = {
    "pairs": one_more,
    "latency": slowed,
    "determinism": same_bytes,
}
"""What a study's tables do not say."""


def run(bench: Bench, name: str, workers: int) -> None:
    """Run one study and write its tables."""
    study, folder = STUDIES[name](bench), bench.out / name
    outcome = run_study(study, bench.out, LocalEngine(workers), told())
    write_study(outcome, folder, (*COMMAND, str(bench.out), "--only", name))
    parts = [table.markdown() for table in outcome.tables()]
    if name in BESIDES:
        parts.append(BESIDES[name](bench))
    if len(outcome.variants) > 1:
        parts.append(losers(outcome))
    text = "\n".join(parts)
    write_bytes(folder / MARKDOWN, f"# {study.title}\n\n{text}".encode())
    write_bytes(folder / "routes.csv", routes_csv(outcome.drives).encode())
    print(text)


def collect(out: Path) -> None:
    """Put the tables of all studies that were run into one file."""
    found = [out / name / MARKDOWN for name in STUDIES]
    texts = [path.read_text("utf-8") for path in found if path.is_file()]
    write_bytes(out / MARKDOWN, "\n".join(texts).encode())


def frames_of(made: Path, what: tuple[int, int]) -> Path:
    """Make frames once."""
    if (made / "scenes.json").is_file():
        return made
    count, seed = what
    return record_frames(DRIVER, made, FramesOptions(count, seed))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", action="append", choices=STUDIES)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--routes", default="all", help="all, a number or ids")
    parser.add_argument("--target", help="of int8: tensorrt or onnxruntime")
    parser.add_argument("--rules", help="of int8: safe or paper")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    shipped = load_routes()
    try:
        bench = Bench(
            given.out,
            str(model_path(DRIVER)),
            pick_routes(shipped, given.routes),
            len(shipped),
            frames_of(given.out / "frames", CALIBRATION),
            frames_of(given.out / "frames-held-out", HELD_OUT),
            given.target,
            given.rules,
        )
        for name in given.only or STUDIES:
            print(f"\n## {name}\n", flush=True)
            run(bench, name, given.workers)
            collect(given.out)
    except Me2eError as error:
        sys.exit(f"bench_driver: {error}")


if __name__ == "__main__":
    main()
