"""What `bench_driver` keeps beside a study's own tables: CSV, and pairs of drives."""

import csv
import io
from collections.abc import Iterable

from me2e_compress.evaluators.highway.results import ResultsFolder
from me2e_compress.metrics.differences import PairedDifference, difference
from me2e_compress.metrics.route_summary import RouteSummary
from me2e_compress.study import Condition, StudyResult, Variant
from me2e_compress.study.cells import estimate_cell
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.workspace import Workspace
from me2e_compress.workflows.result import Cell, Table

COLUMNS = (
    *("scheme", "condition", "route", "driving_score_percent", "succeeded", "ending"),
    *("infractions", "room_kept_percent"),
)

Drive = tuple[Variant, Condition]


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


def among_conditions(
    workspace: Workspace,
    variant: Variant,
    conditions: Iterable[Condition],
    to: Condition,
) -> Table:
    """One driver under several conditions minus itself under another one.

    Args:
        workspace: Where it was driven.
        variant: The driver.
        conditions: All of them were driven.
        to: The one that is subtracted.
    """
    pairs = [
        (each.name, (variant, each), (variant, to)) for each in conditions if each != to
    ]
    title = f"{variant.name}: difference to {to.name} on the same routes"
    return _paired(workspace, title, "condition", pairs)


def among_variants(
    workspace: Workspace, pairs: Iterable[tuple[Variant, Variant]], condition: Condition
) -> Table:
    """Each first driver minus the second, under one condition.

    Args:
        workspace: Where they were driven.
        pairs: Both of each were driven, or the row is left out.
        condition: Of all.
    """
    named = [
        (f"{one.name} minus {two.name}", (one, condition), (two, condition))
        for one, two in pairs
    ]
    return _paired(workspace, "One more module away", "variants", named)


def _paired(
    workspace: Workspace,
    title: str,
    first: str,
    pairs: Iterable[tuple[str, Drive, Drive]],
) -> Table:
    rows = [
        (Cell(name), *_cells(difference(more, less)))
        for name, one, two in pairs
        if (more := _driven(workspace, *one)) and (less := _driven(workspace, *two))
    ]
    return Table(
        title,
        (
            *(first, "DS, points", "room, points", "SR, points"),
            *("routes better", "routes worse"),
        ),
        tuple(rows),
        "Mean over routes with its 95 % interval, paired bootstrap.",
    )


def losers(outcome: StudyResult) -> str:
    """Name the drives that are worse than the baseline's beyond doubt."""
    sure = [
        f"{drive.variant} ({drive.condition})"
        for drive in outcome.drives
        if drive.difference is not None
        and (high := drive.difference.driving_score.high) is not None
        and high < 0.0
    ]
    names = ", ".join(sure) or "none"
    return f"Driving score lost, the 95 % interval without zero: {names}.\n"


def _cells(found: PairedDifference) -> tuple[Cell, ...]:
    return (
        estimate_cell(found.driving_score, signed=True),
        estimate_cell(found.room_kept, signed=True),
        estimate_cell(found.success_rate, signed=True),
        Cell(str(found.better)),
        Cell(str(found.worse)),
    )


def _driven(
    workspace: Workspace, variant: Variant, condition: Condition
) -> list[RouteSummary]:
    """Give the episodes; none where nobody drove."""
    folder = workspace.results(variant, condition)
    if not folder.is_dir():
        return []
    episodes = ResultsFolder.open(folder).episodes().values()
    return [RouteSummary.of(each) for each in episodes]
