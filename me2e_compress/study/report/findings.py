"""A study in sentences: one per variant, with what is certain and what is not."""

from dataclasses import dataclass

from me2e_compress.metrics.measure import Estimate, Measure
from me2e_compress.study.drives import Drive
from me2e_compress.study.outcome import StudyResult, VariantOutcome
from me2e_compress.study.tables import number

TIMES = "\N{MULTIPLICATION SIGN}"


@dataclass(frozen=True)
class Takeaway:
    """What a reader should remember about a variant, in one sentence."""

    variant: str
    text: str


def findings(outcome: StudyResult) -> tuple[Takeaway, ...]:
    """Describe for every variant what it costs and how it drives."""
    baseline = outcome.variant(outcome.study.baseline)
    return tuple(
        Takeaway(variant.name, _sentence(outcome, baseline, variant))
        for variant in outcome.variants
        if variant is not baseline
    )


def _sentence(
    outcome: StudyResult, baseline: VariantOutcome, variant: VariantOutcome
) -> str:
    costs = [
        _times(variant.size_mb, baseline.size_mb, "the size"),
        _times(variant.latency_ms[50], baseline.latency_ms[50], "the median latency"),
    ]
    drives = [each for each in outcome.drives if each.variant == variant.name]
    several = len(outcome.study.conditions) > 1
    roads = [_road(each, several) for each in drives]
    parts = [", ".join(filter(None, costs)), *filter(None, roads)]
    return ("; ".join(filter(None, parts)) or "nothing could be compared") + "."


def _times(one: Measure, other: Measure, what: str) -> str:
    if one.value is None or not other.value:
        return ""
    return f"{one.value / other.value:.2f} {TIMES} {what}"


def _road(drive: Drive, several: bool) -> str:
    where = f"{drive.condition}: " if several else ""
    if drive.difference is None:
        return ""
    found = drive.difference.driving_score
    value = number(found.value or 0.0, "+.1f")
    if found.low is None or found.high is None:
        return f"{where}driving score {value} points on {found.n} route"
    low, high = (number(each, "+.1f") for each in (found.low, found.high))
    said = f"{where}driving score {value} points ({low} to {high})"
    limit = f"{found.n} routes show none below {drive.difference.smallest_shown:.1f}"
    return f"{said}, {drive.difference.verdict}; {limit}"


def sure(found: Estimate) -> int:
    """Return the sign of a difference that is certain as printed, otherwise 0."""
    if found.low is not None and round(found.low, 1) > 0.0:
        return 1
    if found.high is not None and round(found.high, 1) < 0.0:
        return -1
    return 0
