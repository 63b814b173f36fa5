"""What `bench_driver` keeps beside a study's own tables: CSV, and pairs of drives."""

import csv
import io
from collections.abc import Iterable, Mapping

from me2e_compress.evaluators.highway.results import ResultsFolder
from me2e_compress.metrics.differences import PairedDifference, difference
from me2e_compress.metrics.measure import Estimate
from me2e_compress.metrics.route_summary import RouteSummary
from me2e_compress.metrics.scores import Scores
from me2e_compress.study import Condition, StudyResult, Variant
from me2e_compress.study.cells import estimate_cell
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.workspace import Workspace
from me2e_compress.workflows.result import Cell, Table

Value = float | int | str | None
Row = Mapping[str, Value]

DIGITS = 4
"""After the point, of means and intervals."""


def scores_csv(outcome: StudyResult) -> str:
    """One row a variant and condition; what was not measured is empty."""
    return _csv([_scores(outcome, drive) for drive in outcome.drives])


def routes_csv(outcome: StudyResult) -> str:
    """One row a variant, condition and route."""
    return _csv(
        [
            {
                "scheme": drive.variant,
                "condition": drive.condition,
                "route": each.route,
                "driving_score_percent": each.driving_score,
                "succeeded": int(each.succeeded),
                "ending": each.ending,
                "infractions": " ".join(kind for kind, _ in each.moments),
            }
            for drive in outcome.drives
            for each in drive.routes
        ]
    )


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
    reference = _routes(workspace, variant, to)
    rows = [
        (Cell(each.name), *_cells(difference(episodes, reference)))
        for each in conditions
        if each != to and (episodes := _routes(workspace, variant, each))
    ]
    return Table(
        f"{variant.name}: difference to {to.name} on the same routes",
        ("condition", "DS, points", "SR, points", "routes better", "routes worse"),
        tuple(rows),
        "Mean over routes with its 95 % interval, paired bootstrap.",
    )


def among_variants(
    workspace: Workspace, pairs: Iterable[tuple[Variant, Variant]], condition: Condition
) -> Table:
    """Each first driver minus the second, under one condition.

    Args:
        workspace: Where they were driven.
        pairs: Both of each were driven, or the row is left out.
        condition: Of all.
    """
    rows = [
        (Cell(f"{one.name} minus {two.name}"), *_cells(difference(more, less)))
        for one, two in pairs
        if (more := _driven(workspace, one, condition))
        and (less := _driven(workspace, two, condition))
    ]
    return Table(
        "One more module away",
        ("variants", "DS, points", "SR, points", "routes better", "routes worse"),
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
        estimate_cell(found.success_rate, signed=True),
        Cell(str(found.better)),
        Cell(str(found.worse)),
    )


def _routes(
    workspace: Workspace, variant: Variant, condition: Condition
) -> list[RouteSummary]:
    folder = ResultsFolder.open(workspace.results(variant, condition))
    return [RouteSummary.of(each) for each in folder.episodes().values()]


def _driven(
    workspace: Workspace, variant: Variant, condition: Condition
) -> list[RouteSummary]:
    """Give the episodes; none where nobody drove."""
    if not workspace.results(variant, condition).is_dir():
        return []
    return _routes(workspace, variant, condition)


def _scores(outcome: StudyResult, drive: DriveRecord) -> Row:
    variant = outcome.variant(drive.variant)
    return {
        "scheme": drive.variant,
        "condition": drive.condition,
        **_means(drive.scores),
        **_losses(drive.difference),
        "size_mb": variant.size_mb.value,
        "latency_p50_ms": variant.latency_ms[50].value,
        "latency_p99_ms": variant.latency_ms[99].value,
        "plan_displacement_mean_m": variant.fidelity.mean_m.value,
        "plan_displacement_max_m": variant.fidelity.max_m.value,
        "plan_sqnr_db": variant.fidelity.plan_sqnr_db.value,
    }


def _means(found: Scores | None) -> Row:
    return {
        "routes": None if found is None else found.routes,
        **_ends("driving_score_percent", None if not found else found.driving_score),
        **_ends("success_rate_percent", None if not found else found.success_rate),
        **_ends("efficiency_percent", None if not found else found.efficiency),
        **_ends("comfort", None if not found else found.comfort),
    }


def _losses(found: PairedDifference | None) -> Row:
    return {
        **_ends("driving_score_difference", None if not found else found.driving_score),
        **_ends("success_rate_difference", None if not found else found.success_rate),
        "routes_better": None if found is None else found.better,
        "routes_worse": None if found is None else found.worse,
    }


def _ends(name: str, found: Estimate | None) -> Row:
    keys = (name, f"{name}_low", f"{name}_high")
    if found is None:
        return dict.fromkeys(keys)
    ends = (found.value, found.low, found.high)
    rounded = (None if each is None else round(each, DIGITS) for each in ends)
    return dict(zip(keys, rounded, strict=True))


def _csv(rows: list[Row]) -> str:
    text = io.StringIO()
    if rows:
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return text.getvalue()
