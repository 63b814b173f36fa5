"""A study over all routes: what benchmarks/ keeps of it.

    python -m benchmarks.measure.study benchmarks/shifts.toml OUT [--tables A,B]
    python -m benchmarks.measure.study benchmarks/road_2/trained.toml OUT --so-far

Drives what OUT lacks, as ``me2e-compress study FILE -o OUT`` does: hours, and it goes
on where it was ended. OUT/NAME gets its report; the folder beside the file that has its
name its tables and a line a route; with ``--tables A`` they are kept in a folder A of
it, so that what took hours lands by itself. ``--so-far`` drives nothing, and keeps a
line of every route that OUT has.
"""

import argparse
import sys
import time
from pathlib import Path

from benchmarks.tools.driver_records import routes_csv
from me2e_compress.base.atomic import write_bytes
from me2e_compress.base.errors import Me2eError
from me2e_compress.evaluators.highway.engine import LocalEngine
from me2e_compress.evaluators.results import ResultsFolder
from me2e_compress.study import Listener, Study, load_study, run_study
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.report.page import write_study
from me2e_compress.study.workspace import Workspace


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


def keep(name: str, part: str, study: Study, out: Path, workers: int) -> None:
    """Drive a study in a folder, and keep its tables and routes.

    ``part`` names the blocks that are driven, if it is not all of them.

    Raises:
        Me2eError: The folder is another study's, or the baseline fails.
    """
    found = run_study(study, out, LocalEngine(workers), told())
    command = ("python", "-m", "benchmarks.measure.study", name, str(out))
    written = write_study(found, out / Path(name).stem, command)
    folder = kept_in(name, part)
    write_bytes(folder / "tables.md", written.tables.read_bytes())
    write_bytes(folder / "routes.csv", routes_csv(found.drives).encode())


def keep_so_far(name: str, part: str, study: Study, out: Path) -> None:
    """Keep the routes that were driven, of drives that are not at their end."""
    workspace, drives = Workspace(out), list[DriveRecord]()
    for condition in study.conditions:
        for variant in study.driven_under(condition):
            path = workspace.results(variant, condition)
            if path.is_dir():
                driven = ResultsFolder.open(path).episodes().values()
                names = variant.name, condition.name
                drives.append(DriveRecord.of(*names, {}, driven))
                print(f"{'.'.join(names)}: {len(driven)} of {study.set_size} routes")
    folder = kept_in(name, part)
    write_bytes(folder / "routes.csv", routes_csv(drives).encode())


def kept_in(name: str, part: str) -> Path:
    """Return the folder of what is kept of a study, or of a part of its blocks."""
    folder = Path(name).with_suffix("") / part
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", help="the study's file")
    parser.add_argument("out", type=Path)
    parser.add_argument("--tables", help="of its blocks only these")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--so-far", action="store_true", help="drive nothing")
    given = parser.parse_args()
    try:
        study = load_study(given.study)
        if given.tables is not None:
            study = study.of_blocks(given.tables.split(","))
        part = (given.tables or "").replace(",", "-")
        if given.so_far:
            keep_so_far(given.study, part, study, given.out)
        else:
            keep(given.study, part, study, given.out, given.workers)
    except Me2eError as error:
        sys.exit(f"study: {error}")


if __name__ == "__main__":
    main()
