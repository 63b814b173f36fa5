"""A comparison of two drivers in a few lines: size, time, plan, and the road."""

from collections.abc import Iterator

from me2e_compress.metrics.differences import PairedDifference, shown_by
from me2e_compress.study.outcome import StudyResult, VariantOutcome
from me2e_compress.study.tables import number


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


def _road(found: PairedDifference, outcome: StudyResult) -> str:
    score = found.driving_score
    said = f"on the road: {number(score.value or 0.0, '+.1f')} points of driving score"
    if score.low is not None and score.high is not None:
        low, high = (number(each, "+.1f") for each in (score.low, score.high))
        said += f" (95 %: {low} to {high})"
    routes, whole = score.n, outcome.coverage[1]
    if not found.differ:
        most = f"{found.unseen_percent:.0f} %"
        said += f"; 0 of {routes} routes differ, with 95 % at most {most} of all do"
    limit = f"{routes} route{'s' * (routes > 1)} cannot show a difference below"
    said += f": {found.verdict}; {limit} {found.smallest_shown:.0f} points"
    if routes < whole:
        said += f", all {whole} (--routes all) none below {shown_by(whole):.1f}"
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
