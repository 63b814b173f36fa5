"""A comparison of two drivers in a few lines: size, time, plan, and the road."""

import math
from collections.abc import Iterator

from me2e_compress.metrics.differences import PairedDifference
from me2e_compress.study.outcome import StudyResult, VariantOutcome
from me2e_compress.study.tables import number

SCATTER = 12.0
"""Standard deviation, points a route, of the driving score's paired difference between
the driver that ships and its int8 forms on the 220 routes, decisions free: 11.2 to 12.9
(``benchmarks/driver/schemes``)."""

Z = 1.96
"""Of a 95 % interval."""


def verdict(outcome: StudyResult, name: str) -> Iterator[str]:
    """Say how a variant differs from the baseline, and what that many routes can show.

    Args:
        outcome: of a study with one condition.
        name: the variant.
    """
    before, after = outcome.variant(outcome.study.baseline), outcome.variant(name)
    yield "; ".join([_size(before, after), _time(before, after), _plan(after)])
    (drive,) = (each for each in outcome.drives if each.variant == name)
    if drive.difference is None:
        yield f"on the road: not measured ({drive.reason})"
    else:
        yield _road(drive.difference, outcome)


def smallest_shown(found: PairedDifference) -> float:
    """Return the smallest difference that so many routes show, in points.

    Half the width of the interval that the mean would have if routes scattered as
    those of `SCATTER`, or of its own where that is wider: on few routes nothing may
    differ by chance.
    """
    score = found.driving_score
    usual = _shown_by(score.n)
    if score.low is None or score.high is None:
        return usual
    return max(usual, (score.high - score.low) / 2)


def _shown_by(routes: int) -> float:
    return Z * SCATTER / math.sqrt(routes)


def _road(found: PairedDifference, outcome: StudyResult) -> str:
    score = found.driving_score
    said = f"on the road: {number(score.value or 0.0, '+.1f')} points of driving score"
    differs = False
    if score.low is not None and score.high is not None:
        low, high = (number(each, "+.1f") for each in (score.low, score.high))
        said += f" (95 %: {low} to {high})"
        differs = not score.low <= 0 <= score.high
    routes, whole = score.n, outcome.coverage[1]
    if not found.differ:
        most = f"{found.unseen_percent:.0f} %"
        said += f"; 0 of {routes} routes differ, with 95 % at most {most} of all do"
    shown = "a difference" if differs else "no difference shown"
    limit = f"{routes} route{'s' * (routes > 1)} cannot show one below"
    said += f": {shown}; {limit} {smallest_shown(found):.0f} points"
    if routes < whole:
        said += f", all {whole} (--routes all) none below {_shown_by(whole):.1f}"
    return said


def _size(before: VariantOutcome, after: VariantOutcome) -> str:
    old, new = before.size_mb.value, after.size_mb.value
    if old is None or new is None:
        return f"size: not measured ({before.size_mb.reason or after.size_mb.reason})"
    return f"{new:.2f} MB, {new / old:.0%} of {old:.2f}"


def _time(before: VariantOutcome, after: VariantOutcome) -> str:
    old, new = before.latency_ms[50], after.latency_ms[50]
    if old.value is None or new.value is None:
        return f"time: not measured ({old.reason or new.reason})"
    share = f"{new.value / old.value:.0%} of {old.value:.1f}"
    return f"{new.value:.1f} ms a decision, {share}"


def _plan(after: VariantOutcome) -> str:
    moved, most = after.fidelity.mean_m, after.fidelity.max_m
    if moved.value is None or most.value is None:
        return f"plan: not measured ({moved.reason})"
    return (
        f"the plan moves {moved.value:.3f} m on average, {most.value:.2f} m at most"
        f" ({after.fidelity.frames} held-out frames)"
    )
