"""Comparison of two drives route by route, whatever differs between them.

A condition that changes one thing about another (``against``) shows what the change
costs each variant, and whether it costs more than it costs the baseline: a mean of
paired differences of differences. A pair compares any two drives.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from me2e_compress.metrics.measure import Estimate
from me2e_compress.study.condition import Condition
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.route_columns import DS, SR, Column
from me2e_compress.study.route_summary import RouteSummary


@dataclass(frozen=True)
class Change:
    """One drive (``VARIANT.CONDITION``) minus another over the same routes, in points.

    The ``beyond`` estimates are the change minus the baseline's; None for the baseline
    itself, and for a pair.
    """

    drive: str
    against: str
    driving_score: Estimate
    success_rate: Estimate
    beyond_driving_score: Estimate | None = None
    beyond_success_rate: Estimate | None = None

    def to_json(self) -> dict[str, Any]:
        """Return both names and every estimate."""
        beyond = (self.beyond_driving_score, self.beyond_success_rate)
        score, rate = (None if each is None else each.to_json() for each in beyond)
        return {
            "drive": self.drive,
            "against": self.against,
            "driving_score": self.driving_score.to_json(),
            "success_rate": self.success_rate.to_json(),
            "beyond_baseline": {"driving_score": score, "success_rate": rate},
        }


def changes(
    conditions: Sequence[Condition],
    drives: Sequence[DriveRecord],
    baseline: str,
    seed: int,
) -> tuple[Change, ...]:
    """Compare every drive with the one that its condition changes, if there is one."""
    there = _by_cell(drives)
    found = list[Change]()
    for condition in (each for each in conditions if each.against):
        for drive in (each for each in drives if each.condition == condition.name):
            # the drive and its counterpart, of the variant and the baseline
            cells = [
                (variant, name)
                for variant in (drive.variant, baseline)
                for name in (condition.name, condition.against)
            ]
            if not all(cell in there for cell in cells):
                continue
            ours, before, theirs, theirs_before = (there[cell] for cell in cells)
            # the plain difference, and how far it exceeds the baseline's
            change = _change(cells[0], cells[1], ours, before, seed)
            if drive.variant != baseline:
                four = ours, before, theirs, theirs_before
                score, rate = (_beyond(column, *four, seed) for column in (DS, SR))
                change = replace(
                    change, beyond_driving_score=score, beyond_success_rate=rate
                )
            found.append(change)
    return tuple(found)


def held_against(
    pairs: Sequence[tuple[str, str]], drives: Sequence[DriveRecord], seed: int
) -> tuple[Change, ...]:
    """Compare pairs of drives (``VARIANT.CONDITION``) if both were driven."""
    there = _by_cell(drives)
    cells = [(_cell(one), _cell(other)) for one, other in pairs]
    return tuple(
        _change(one, other, there[one], there[other], seed)
        for one, other in cells
        if one in there and other in there
    )


def _by_cell(
    drives: Sequence[DriveRecord],
) -> Mapping[tuple[str, str], tuple[RouteSummary, ...]]:
    return {
        (each.variant, each.condition): each.routes for each in drives if each.routes
    }


def _cell(name: str) -> tuple[str, str]:
    variant, _, condition = name.partition(".")
    return variant, condition


def _change(
    cell: tuple[str, str],
    other: tuple[str, str],
    ours: Sequence[RouteSummary],
    others: Sequence[RouteSummary],
    seed: int,
) -> Change:
    score, rate = (
        (column.values(ours) - column.values(others)).mean(seed) for column in (DS, SR)
    )
    return Change(".".join(cell), ".".join(other), score, rate)


def _beyond(
    column: Column,
    ours: Sequence[RouteSummary],
    before: Sequence[RouteSummary],
    theirs: Sequence[RouteSummary],
    theirs_before: Sequence[RouteSummary],
    seed: int,
) -> Estimate:
    """Return how much more ours changed than theirs."""
    change = column.values(ours) - column.values(before)
    their_change = column.values(theirs) - column.values(theirs_before)
    return (change - their_change).mean(seed)
