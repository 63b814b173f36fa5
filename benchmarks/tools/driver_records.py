"""A line a route: what benchmarks keep of drives."""

import csv
import io
from collections.abc import Iterable

from me2e_compress.study.drive_record import DriveRecord

COLUMNS = (
    *("scheme", "condition", "route", "driving_score_percent", "succeeded", "ending"),
    *("infractions", "room_kept_percent"),
)


def routes_csv(drives: Iterable[DriveRecord]) -> str:
    """One row a variant, condition and route."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for drive in drives:
        for each in drive.routes:
            infractions = " ".join(kind for kind, _ in each.moments)
            found = (each.driving_score, int(each.succeeded), each.ending, infractions)
            room = "" if each.room_kept is None else round(each.room_kept, 3)
            names = (drive.variant, drive.condition, each.route)
            writer.writerow((*names, *found, room))
    return text.getvalue()
