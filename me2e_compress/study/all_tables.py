"""All tables of a study, including near misses and endings of routes."""

from dataclasses import replace
from typing import TYPE_CHECKING

from me2e_compress.study.drives import Drive
from me2e_compress.study.tables import (
    MISSING,
    abilities,
    change_tables,
    differences,
    estimate_cell,
    scoreboards,
)
from me2e_compress.workflows.result import Cell, Table

if TYPE_CHECKING:
    from me2e_compress.study.outcome import StudyResult

MOST_ROUTES = 40
"""With more routes than this, the table of endings is left out."""
COLUMNS = ("TTC < 1.5 s, %", "least TTC s", "PET s", "distance m", "at fault %")


def all_tables(outcome: "StudyResult") -> tuple[Table, ...]:
    """Return every table of a study, in reading order; a preview is marked as such."""
    compared = [differences(outcome)] if len(outcome.variants) > 1 else []
    found = (
        *scoreboards(outcome),
        *compared,
        *change_tables(outcome),
        *filter(None, [route_table(outcome)]),
        near_misses(outcome),
        *abilities(outcome),
    )
    preview = outcome.study.preview
    return tuple(replace(each, title=f"{each.title}{preview}") for each in found)


def route_table(outcome: "StudyResult") -> Table | None:
    """Show how each route ended for each driver; None if there are too many routes."""
    driven = [each for each in outcome.drives if each.routes]
    if not driven or len(driven[0].routes) > MOST_ROUTES:
        return None
    # one column per drive, one row per route
    several = len(outcome.study.conditions) > 1
    names = [f"{e.variant}, {e.condition}" if several else e.variant for e in driven]
    return Table(
        "How each route ended",
        ("route", *names),
        tuple(
            (
                Cell(routes[0].route),
                *(Cell(f"{each.driving_score:.1f}", each.fate) for each in routes),
            )
            for routes in zip(*(each.routes for each in driven), strict=True)
        ),
        "Driving score, and why it is not 100.",
    )


def near_misses(outcome: "StudyResult") -> Table:
    """Show how near every drive came to collisions, which end few routes."""
    several = len(outcome.study.conditions) > 1
    return Table(
        "Near misses",
        ("variant", *COLUMNS),
        tuple(
            (
                Cell(f"{each.variant}, {each.condition}" if several else each.variant),
                *_cells(each),
            )
            for each in outcome.drives
        ),
        "Means over routes with their 95 % intervals: share of the time with a time to "
        "collision below 1.5 s, the least of a route, post-encroachment time of "
        "crossing paths, smallest distance; and routes with a collision that the ego "
        "could have prevented. Least TTC and PET exist on some routes only.",
        outcome.study.baseline,
    )


def _cells(drive: Drive) -> tuple[Cell, ...]:
    if drive.scores is None:
        return (Cell(MISSING, reason=drive.reason),) * len(COLUMNS)
    found = drive.scores.safety
    return (
        estimate_cell(found.ttc_exposure),
        estimate_cell(found.smallest_ttc, ".2f"),
        estimate_cell(found.smallest_pet, ".2f"),
        estimate_cell(found.smallest_distance, ".2f"),
        estimate_cell(found.at_fault_collisions),
    )
