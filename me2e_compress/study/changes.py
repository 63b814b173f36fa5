"""Comparison of two drives route by route, whatever differs between them.

A condition that changes one thing about another (``against``) shows what the change
costs each variant, and whether it costs more than it costs the baseline: a mean of
paired differences of differences. A pair compares any two drives.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from me2e_compress.metrics.measure import Estimate
from me2e_compress.metrics.route_summary import DS, ROOM, SR, RouteColumn
from me2e_compress.study.condition import Condition
from me2e_compress.study.drive_record import DriveRecord


@dataclass(frozen=True)
class Change:
    """One drive (``VARIANT.CONDITION``) minus another over the same routes, in points.

    The ``beyond`` estimates are the change minus the baseline's; None for the baseline
    itself, and for a pair.
    """

    drive: str
    against: str
    driving_score: Estimate
    room_kept: Estimate
    success_rate: Estimate
    beyond_driving_score: Estimate | None = None
    beyond_room_kept: Estimate | None = None
    beyond_success_rate: Estimate | None = None

    def to_json(self) -> dict[str, Any]:
        """Return both names and every estimate."""
        beyond = {
            "driving_score": self.beyond_driving_score,
            "room_kept": self.beyond_room_kept,
            "success_rate": self.beyond_success_rate,
        }
        return {
            "drive": self.drive,
            "against": self.against,
            "driving_score": self.driving_score.to_json(),
            "room_kept": self.room_kept.to_json(),
            "success_rate": self.success_rate.to_json(),
            "beyond_baseline": {
                name: None if each is None else each.to_json()
                for name, each in beyond.items()
            },
        }


def changes(
    conditions: Sequence[Condition],
    drives: Sequence[DriveRecord],
    baseline: str,
    seed: int,
) -> tuple[Change, ...]:
    """Compare every drive with the one that its condition changes, if there is one."""
    there = _by_name(drives)
    found = list[Change]()
    for condition in (each for each in conditions if each.against):
        for drive in (each for each in drives if each.condition == condition.name):
            # the drive and its counterpart, of the variant and the baseline
            four = [
                there.get(f"{variant}.{name}")
                for variant in (drive.variant, baseline)
                for name in (condition.name, condition.against)
            ]
            ours, before, theirs, theirs_before = four
            if not (ours and before and theirs and theirs_before):
                continue
            # the plain difference, and how far it exceeds the baseline's
            change = _change(ours, before, seed)
            if drive.variant != baseline:
                both = (ours, before), (theirs, theirs_before)
                change = replace(
                    change,
                    beyond_driving_score=_beyond(DS, *both, seed),
                    beyond_room_kept=_beyond(ROOM, *both, seed),
                    beyond_success_rate=_beyond(SR, *both, seed),
                )
            found.append(change)
    return tuple(found)


def held_against(
    pairs: Sequence[tuple[str, str]], drives: Sequence[DriveRecord], seed: int
) -> tuple[Change, ...]:
    """Compare pairs of drives (``VARIANT.CONDITION``) if both were driven."""
    there = _by_name(drives)
    return tuple(
        _change(there[one], there[other], seed)
        for one, other in pairs
        if one in there and other in there
    )


def _by_name(drives: Sequence[DriveRecord]) -> dict[str, DriveRecord]:
    return {each.name: each for each in drives if each.routes}


def _change(drive: DriveRecord, other: DriveRecord, seed: int) -> Change:
    found = (drive.minus(other, column, seed) for column in (DS, ROOM, SR))
    return Change(drive.name, other.name, *found)


Pair = tuple[DriveRecord, DriveRecord]


def _beyond(column: RouteColumn, ours: Pair, theirs: Pair, seed: int) -> Estimate:
    """Return how much more ours changed than theirs."""
    change, their_change = (
        after.values(column) - before.values(column) for after, before in (ours, theirs)
    )
    return (change - their_change).mean(seed)
