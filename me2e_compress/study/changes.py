"""Comparison of two drives route by route, whatever differs between them.

A condition that changes one thing about another (``against``) shows what the change
costs each variant, and whether it costs more than it costs the baseline: a mean of
paired differences of differences. A pair compares any two drives.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from me2e_compress.metrics.differences import POINTS, WIDEST
from me2e_compress.metrics.intervals import mean_estimate
from me2e_compress.metrics.measure import Estimate
from me2e_compress.study.condition import Condition
from me2e_compress.study.drives import Drive
from me2e_compress.study.route_outcomes import RouteOutcome

TWICE = (2.0 * WIDEST[0], 2.0 * WIDEST[1])
"""Bounds of a difference of differences of a route, in points."""


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
    conditions: Sequence[Condition], drives: Sequence[Drive], baseline: str, seed: int
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
                score, rate = _beyond(ours, before, theirs, theirs_before, seed)
                change = replace(
                    change, beyond_driving_score=score, beyond_success_rate=rate
                )
            found.append(change)
    return tuple(found)


def held_against(
    pairs: Sequence[tuple[str, str]], drives: Sequence[Drive], seed: int
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
    drives: Sequence[Drive],
) -> Mapping[tuple[str, str], tuple[RouteOutcome, ...]]:
    return {
        (each.variant, each.condition): each.routes for each in drives if each.routes
    }


def _cell(name: str) -> tuple[str, str]:
    variant, _, condition = name.partition(".")
    return variant, condition


def _change(
    cell: tuple[str, str],
    other: tuple[str, str],
    ours: Sequence[RouteOutcome],
    others: Sequence[RouteOutcome],
    seed: int,
) -> Change:
    types = [each.scenario for each in ours]
    scores, rates = (
        mean_estimate(
            [a - b for a, b in zip(mine, theirs, strict=True)],
            *(types, POINTS, seed, WIDEST),
        )
        for mine, theirs in zip(_values(ours), _values(others), strict=True)
    )
    return Change(".".join(cell), ".".join(other), scores, rates)


def _beyond(
    ours: Sequence[RouteOutcome],
    before: Sequence[RouteOutcome],
    theirs: Sequence[RouteOutcome],
    theirs_before: Sequence[RouteOutcome],
    seed: int,
) -> tuple[Estimate, Estimate]:
    """Return how much more ours changed than theirs: driving score, success rate."""
    types = [each.scenario for each in ours]
    four = (_values(each) for each in (ours, before, theirs, theirs_before))
    scores, rates = (
        mean_estimate(
            [(a - b) - (c - d) for a, b, c, d in zip(*columns, strict=True)],
            *(types, POINTS, seed, TWICE),
        )
        for columns in zip(*four, strict=True)
    )
    return scores, rates


def _values(routes: Sequence[RouteOutcome]) -> tuple[list[float], list[float]]:
    return (
        [each.driving_score for each in routes],
        [100.0 * each.succeeded for each in routes],
    )
