"""What is kept of a training on the second road: `benchmarks/road_2/training`.

    python -m driver.train -o DIR --road 2 --overlook 0.2 --seed 1 --workers 2
    python -m benchmarks.keep_training DIR

Copies what `driver.train` needs to go on in another folder (the course, its trial's
routes, weights and log of every stage that is at its end) to the seed's folder, and
keeps a line of ``trial.csv`` for every route that a round's driver was tried on. DIR
may be of a training that is not at its end, and is kept again later.
"""

import argparse
import csv
import io
import json
import shutil
import sys
from pathlib import Path

from benchmarks.driver_records import COLUMNS, routes_csv
from driver.checkpoint import TrainingCheckpoint
from driver.course import MANIFEST
from driver.curriculum import SEEDS_APART
from driver.process import CHECKPOINT, LOG
from me2e_compress.errors import Me2eError
from me2e_compress.evaluators.highway.results import ResultsFolder
from me2e_compress.runtime.atomic import write_bytes
from me2e_compress.study.drive_record import DriveRecord

KEPT = Path(__file__).parent / "road_2" / "training"
TRIAL = "trial.csv"


def keep(folder: Path, kept: Path = KEPT) -> str:
    """Keep what there is so far, and return the name of the training.

    Raises:
        TrainingError: A checkpoint cannot be read.
        EvaluationError: The results of a trial cannot be read.
        OSError: There is no course in the folder.
    """
    course = json.loads((folder / MANIFEST).read_text("utf-8"))
    name = f"seed-{course['rounds'][0]['trainings'][0]['seed'] // SEEDS_APART}"
    finished = [
        path
        for path in sorted(folder.glob(f"round-*/training-*/{CHECKPOINT}"))
        if not TrainingCheckpoint.load(path).optimizer
    ]
    logs = [path.with_name(LOG) for path in finished]
    # what it needs to go on
    for path in (folder / MANIFEST, folder / "trial.json", *finished, *logs):
        place = kept / name / path.relative_to(folder)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, place)
    # how each round's driver drove
    drives = list[DriveRecord]()
    for path in sorted(folder.glob("round-*/trial")):
        episodes = ResultsFolder.open(path).episodes().values()
        scheme = f"{name}-{path.parent.name}"
        drives.append(DriveRecord.of(scheme, "five", {}, episodes))
    table = kept / TRIAL
    old = table.read_text("utf-8") if table.exists() else ""
    write_bytes(table, with_rows(old, routes_csv(drives)).encode())
    return name


def with_rows(old: str, fresh: str) -> str:
    """Return a table of routes in which the drives of another are in their place."""
    new = list(csv.DictReader(io.StringIO(fresh)))
    driven = {row["scheme"] for row in new}
    rows = [r for r in csv.DictReader(io.StringIO(old)) if r["scheme"] not in driven]
    rows = sorted(
        rows + new, key=lambda row: (row["scheme"] != "shipped", row["scheme"])
    )
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="of driver.train")
    given = parser.parse_args()
    try:
        print(f"{KEPT / keep(given.folder)}: kept")
    except (Me2eError, OSError) as error:
        sys.exit(f"keep_training: {error}")


if __name__ == "__main__":
    main()
