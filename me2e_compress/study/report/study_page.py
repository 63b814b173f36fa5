"""The page of a comparison: what to remember, then figures and tables."""

import base64
from collections.abc import Mapping, Sequence

from markupsafe import Markup

from me2e_compress.display import counted
from me2e_compress.metrics.measure import Estimate, Measure
from me2e_compress.metrics.route_summary import RouteSummary
from me2e_compress.study.cells import number
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.outcome import StudyOutcome, VariantOutcome
from me2e_compress.study.report.curves import curves
from me2e_compress.study.report.figures import forest, pareto
from me2e_compress.study.report.page import Drawing, Page, Section
from me2e_compress.study.side_by_side import Contrast
from me2e_compress.study.study_result import StudyResult

TIMES = "\N{MULTIPLICATION SIGN}"
COSTS = "What a point of driving score costs"
APART = "Where they part"


def study_page(
    outcome: StudyResult,
    command: Sequence[str] = (),
    sections: Sequence[Section] = (),
) -> Page:
    """Return the page of a comparison; ``sections`` stand before how it was made."""
    baseline = outcome.study.baseline
    found = findings(outcome)
    note = (
        f"Against {baseline}, the same routes; in brackets the 95 % interval of the"
        " mean difference."
    )
    return Page(
        outcome.title,
        _lede(outcome),
        [*_sections(outcome), *sections],
        _made(outcome, command),
        [_recipe(each) for each in outcome.variants],
        found,
        note if found else "",
        outcome.alerts(),
    )


def _sections(outcome: StudyResult) -> list[Section]:
    """Return the sections that have something to show, in reading order."""
    tables = dict(outcome.tables_by_section)
    headings = [*tables, APART]
    headings.insert(headings.index("Route by route"), COSTS)
    drawings, notes = _drawings(outcome), _notes(outcome.study.baseline)
    # without a difference there is nothing to compare
    if not drawings["Paired differences"]:
        tables["Paired differences"] = ()
    found = [
        Section(
            name,
            tables.get(name, ()),
            drawings=drawings.get(name, ()),
            note=notes.get(name, ""),
        )
        for name in headings
    ]
    return [each for each in found if each.tables or each.drawings]


def _drawings(outcome: StudyResult) -> Mapping[str, tuple[Drawing, ...]]:
    """Return the figures by the heading that they stand under."""
    study = outcome.study
    curve, gaps = curves(outcome), forest(outcome)
    fronts = {each.name: pareto(outcome, each) for each in study.conditions}
    drawn = {name: front for name, front in fronts.items() if front is not None}
    over_conditions = "Dots are means over routes, bars their 95 % intervals."
    to_baseline = (
        f"Each dot is the mean difference to {study.baseline} over the routes, the bar"
        " its 95 % interval; blue where it does not hold zero."
    )
    return {
        "Scoreboard": () if curve is None else (Drawing(curve, over_conditions),),
        "Paired differences": () if gaps is None else (Drawing(gaps, to_baseline),),
        COSTS: tuple(
            Drawing(front, caption=name if len(drawn) > 1 else "")
            for name, front in drawn.items()
        ),
        APART: tuple(_contrast(each, study.baseline) for each in outcome.contrasts),
    }


def _notes(baseline: str) -> Mapping[str, str]:
    return {
        COSTS: "The line joins the variants that no other beats on both counts. Bars:"
        f" 95 % intervals of the driving score. Black: {baseline}. Where there are"
        f" many, only the front and {baseline} are named.",
        APART: f"The front cameras of both, {baseline}'s above. From above: {baseline}"
        " and its plan in grey; the other in blue, its plan in orange, with its"
        " traffic; the route in pale blue; crosses mark infractions. A drive that was"
        " over by then shows its last moment.",
    }


def _lede(outcome: StudyResult) -> str:
    # what was driven
    study = outcome.study
    driven, whole = outcome.coverage
    share = f"{driven}" if driven == whole else f"{driven} of {whole}"
    where = f"of {study.evaluator}" if study.elsewhere else "of highway-env"
    names = ", ".join(each.name for each in study.conditions)
    said = (
        f"{counted(len(study.variants), 'variant')} on {share} routes {where}, "
        f"closed loop; {counted(len(study.conditions), 'condition')}: {names}."
    )
    # what so many routes can show
    found = [each.difference for each in outcome.drives if each.difference is not None]
    if not found:
        return said
    least = max(each.smallest_shown for each in found)
    return (
        f"{said} {counted(driven, 'route')} cannot show a difference below {least:.1f}"
        " points of driving score."
    )


def _contrast(contrast: Contrast, baseline: str) -> Drawing:
    route = contrast.route
    words = (
        f"{baseline}, in grey: {_ended(route)}; {contrast.drive.variant}, in colour:"
        f" {_ended(contrast.other)}"
    )
    png = base64.b64encode(contrast.picture.read_bytes()).decode()
    image = Markup('<img src="data:image/png;base64,{}" alt="{}">').format(png, words)
    caption = (
        f"{route.scenario}, {contrast.drive.condition}, "
        f"{contrast.moment_us / 1e6:.1f} s into the route {route.route}; "
        f"at most {contrast.apart.distance_m:.1f} m apart"
    )
    return Drawing(image, caption=caption, words=words)


def _ended(route: RouteSummary) -> str:
    room = route.room_kept
    kept = "" if room is None else f", room kept {room:.1f} %"
    return f"driving score {route.driving_score:.1f}{kept}, {route.fate}"


def _recipe(variant: VariantOutcome) -> tuple[str, str, str | None]:
    """Return name, source and digest."""
    prepared = variant.prepared
    made_of = prepared.source or prepared.variant.policy
    if prepared.pipeline:
        made_of = f"{made_of} → {prepared.pipeline}"
    if prepared.weights:
        made_of = f"{made_of}; {prepared.weights}"
    return variant.name, made_of, prepared.sha256


def _made(outcome: StudyResult, command: Sequence[str]) -> list[tuple[str, str]]:
    timing = outcome.study.timing
    load = "" if outcome.load is None else f"; while it was timed, {outcome.load}"
    timed = (
        f"{timing.samples} inferences a model, in turn, on"
        f" {counted(timing.threads, 'thread')}; device scale {outcome.device_scale:.3g}"
    )
    return [
        ("Command", " ".join(command)),
        ("Machine", f"{outcome.machine}{load}"),
        ("Latency", timed if outcome.timed else ""),
        ("Versions", ", ".join(f"{k} {text}" for k, text in outcome.versions.items())),
        ("Seed", str(outcome.study.seed)),
    ]


def findings(outcome: StudyOutcome) -> tuple[tuple[str, str], ...]:
    """Say of every variant but the baseline what it costs and how it drives."""
    baseline = outcome.variant(outcome.study.baseline)
    return tuple(
        (variant.name, _sentence(outcome, baseline, variant))
        for variant in outcome.variants
        if variant is not baseline
    )


def _sentence(
    outcome: StudyOutcome, baseline: VariantOutcome, variant: VariantOutcome
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


def _road(drive: DriveRecord, several: bool) -> str:
    where = f"{drive.condition}: " if several else ""
    if drive.difference is None:
        return ""
    found = drive.difference.driving_score
    said = _signed(f"{where}driving score ", found)
    if not said:
        value = number(found.value or 0.0, "+.1f")
        return f"{where}driving score {value} points on {found.n} route"
    limit = f"{found.n} routes show none below {drive.difference.smallest_shown:.1f}"
    kept = _signed("; room kept ", drive.difference.room_kept)
    return f"{said}, {drive.difference.verdict}; {limit}{kept}"


def _signed(what: str, gap: Estimate) -> str:
    ends = [each for each in (gap.value, gap.low, gap.high) if each is not None]
    if len(ends) < 3:
        return ""
    value, low, high = (number(each, "+.1f") for each in ends)
    return f"{what}{value} points ({low} to {high})"
