"""A comparison of two drivers on one screen: size, time, plan, driving."""

from collections.abc import Callable

from me2e_compress.display import Cell, Table
from me2e_compress.metrics.measure import Estimate, Measure
from me2e_compress.metrics.route_summary import PairedDifference, shown_by
from me2e_compress.metrics.scores import Scores
from me2e_compress.study.cells import MISSING, measure_cell, number
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.outcome import StudyOutcome


def before_and_after(outcome: StudyOutcome, name: str) -> Table:
    """Compare the baseline and a variant of a study with one condition."""
    # size, latency, plan and driving, one row each
    before, after = outcome.variant(outcome.study.baseline), outcome.variant(name)
    medians = before.latency_ms[50], after.latency_ms[50]
    moved, most = after.fidelity.mean_m, after.fidelity.max_m
    far = "" if most.value is None else f"{most.value:.2f} m at most"
    driven = [_drive(outcome, each.name) for each in (before, after)]
    gap = driven[1].difference
    return Table(
        "Before and after",
        ("", before.name, after.name, ""),
        (
            _row("size, MB", before.size_mb, after.size_mb, ".2f"),
            _row("time of a decision, ms", *medians, ".1f"),
            (
                Cell("the plan moves by, m"),
                Cell(MISSING),
                measure_cell(moved, ".3f"),
                Cell(far),
            ),
            (
                Cell("driving score"),
                *(_score(each, lambda found: found.driving_score) for each in driven),
                Cell("" if gap is None else _points(gap.driving_score)),
            ),
            (
                Cell("room kept, %"),
                *(
                    _score(each, lambda found: found.safety.room_kept)
                    for each in driven
                ),
                Cell("" if gap is None else _points(gap.room_kept)),
            ),
        ),
    )


def road_verdict(outcome: StudyOutcome, name: str) -> str:
    """Say how a variant drives, and what so many routes can show."""
    drive = _drive(outcome, name)
    if drive.difference is None:
        return f"on the road: not measured ({drive.reason})"
    return _road(drive.difference, outcome)


def _road(found: PairedDifference, outcome: StudyOutcome) -> str:
    score = found.driving_score
    routes, whole = score.n, outcome.coverage[1]
    said = f"on the road: {found.verdict}"
    if not found.differ:
        most = f"{found.unseen_percent:.0f} %"
        said += f"; 0 of {routes} routes differ, with 95 % at most {most} of all do"
    limit = f"{routes} route{'s' * (routes > 1)} cannot show a difference below"
    said += f"; {limit} {found.smallest_shown:.0f} points"
    if routes < whole:
        said += f", all {whole} none below {shown_by(whole):.1f}"
    return said


def _drive(outcome: StudyOutcome, name: str) -> DriveRecord:
    (drive,) = (each for each in outcome.drives if each.variant == name)
    return drive


def _row(what: str, before: Measure, after: Measure, form: str) -> tuple[Cell, ...]:
    share = ""
    if before.value and after.value is not None:
        share = f"{after.value / before.value:.0%}"
    return (
        Cell(what),
        measure_cell(before, form),
        measure_cell(after, form),
        Cell(share),
    )


def _score(drive: DriveRecord, pick: Callable[[Scores], Estimate]) -> Cell:
    if drive.scores is None:
        return Cell(MISSING, reason=drive.reason)
    return measure_cell(pick(drive.scores).measure, ".1f")


def _points(gap: Estimate) -> str:
    """Return a difference in points with its 95 % interval; empty if unknown."""
    if gap.value is None:
        return ""
    said = number(gap.value, "+.1f")
    if gap.low is None or gap.high is None:
        return said
    low, high = (number(each, "+.1f") for each in (gap.low, gap.high))
    return f"{said} ({low} to {high})"
