"""A study over all routes: what benchmarks/ keeps of it.

    python -m benchmarks.bench_study shifts OUT [--tables A,B] [--workers N]
    python -m benchmarks.bench_study benchmarks/observers/seed-10.toml OUT

Drives what OUT lacks, as ``me2e-compress study NAME -o OUT`` does: hours, and it goes
on where it was ended. OUT/NAME gets its report; benchmarks/NAME (of a file the folder
beside it that has its name) its tables and a line a route; with ``--tables A`` they are
kept in a folder A of it, so that what took hours lands by itself.
"""

import argparse
import sys
from pathlib import Path

from benchmarks.bench_driver import told
from benchmarks.driver_records import routes_csv
from me2e_compress.errors import Me2eError
from me2e_compress.evaluators.highway.engine import LocalEngine
from me2e_compress.runtime.atomic import write_bytes
from me2e_compress.study import Study, load_study, run_study
from me2e_compress.study.write import write_study

KEPT = Path(__file__).parent


def keep(name: str, part: str, study: Study, out: Path, workers: int) -> None:
    """Drive a study in a folder, and keep its tables and routes beside this file.

    ``part`` names the blocks that are driven, if it is not all of them.

    Raises:
        Me2eError: The folder is another study's, or the baseline fails.
    """
    found = run_study(study, out, LocalEngine(workers), told())
    command = ("python", "-m", "benchmarks.bench_study", name, str(out))
    written = write_study(found, out / Path(name).stem, command)
    folder = KEPT / name if Path(name).suffix == "" else Path(name).with_suffix("")
    folder /= part
    folder.mkdir(parents=True, exist_ok=True)
    write_bytes(folder / "tables.md", written.tables.read_bytes())
    write_bytes(folder / "routes.csv", routes_csv(found).encode())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", help="a name, or a study's file")
    parser.add_argument("out", type=Path)
    parser.add_argument("--tables", help="of its blocks only these")
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    try:
        study = load_study(given.study)
        if given.tables is not None:
            study = study.of_blocks(given.tables.split(","))
        part = (given.tables or "").replace(",", "-")
        keep(given.study, part, study, given.out, given.workers)
    except Me2eError as error:
        sys.exit(f"bench_study: {error}")


if __name__ == "__main__":
    main()
