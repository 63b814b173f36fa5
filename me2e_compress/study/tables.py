"""Tables of a study: one content for the terminal, Markdown and HTML."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from me2e_compress.metrics.abilities import ABILITIES
from me2e_compress.metrics.differences import PairedDifference, holm
from me2e_compress.metrics.measure import Estimate, Measure
from me2e_compress.metrics.scores import Scores
from me2e_compress.study.condition import Condition
from me2e_compress.study.drives import Drive
from me2e_compress.study.plan_fidelity import EXACT
from me2e_compress.workflows.result import Cell, Table, counted
from me2e_compress.workflows.result import number as plain_number

if TYPE_CHECKING:
    from me2e_compress.study.changes import Change
    from me2e_compress.study.outcome import StudyResult, VariantOutcome

MISSING = "\N{EN DASH}"
"""Shown if nothing was measured."""
INFINITE = "\N{INFINITY}"
MINUS = "\N{MINUS SIGN}"
SCORES = ("DS", "SR %", "DE %", "DC")
COSTS = ("size MB", "p50 ms", "p99 ms", "plan m", "SQNR dB")


def scoreboards(outcome: "StudyResult") -> tuple[Table, ...]:
    """Show driving scores, size and latency of all variants, by condition."""
    if len(outcome.variants) > 1:
        return tuple(_scoreboard(outcome, each) for each in outcome.study.conditions)
    return (
        Table(
            f"Scoreboard of {outcome.study.baseline}",
            ("condition", *SCORES),
            tuple((Cell(each.condition), *_scores(each)) for each in outcome.drives),
            _routes_note(outcome),
        ),
    )


def _scoreboard(outcome: "StudyResult", condition: Condition) -> Table:
    return Table(
        f"Scoreboard, {_condition(outcome, condition)}",
        ("variant", *SCORES, *COSTS),
        tuple(
            (Cell(each.variant), *_scores(each), *_costs(outcome.variant(each.variant)))
            for each in outcome.under(condition)
        ),
        f"{_routes_note(outcome)} {_costs_note(outcome)}",
        outcome.study.baseline,
    )


def differences(outcome: "StudyResult") -> Table:
    """Show every variant minus the baseline, paired by route."""
    # drives with a difference to the baseline
    baseline = outcome.study.baseline
    several = len(outcome.study.conditions) > 1
    names, found = list[str](), list[PairedDifference]()
    for drive in outcome.drives:
        if drive.difference is not None:
            found.append(drive.difference)
            name = f"{drive.variant}, {drive.condition}"
            names.append(name if several else drive.variant)
    # p-values are corrected for all comparisons shown
    corrected = holm([each.p_value for each in found])
    return Table(
        f"Difference to {baseline} on the same routes",
        (
            *("variant", "DS, points", "DS, other types", "SR, points", "SR p"),
            *("routes better", "routes worse"),
        ),
        tuple(
            (Cell(name), *_difference(each, p))
            for name, each, p in zip(names, found, corrected, strict=True)
        ),
        _differences_note(found),
    )


def _differences_note(found: Sequence[PairedDifference]) -> str:
    notes = [
        "Mean over routes with its 95 % interval, paired: an interval that holds zero "
        'shows no difference. It is for routes of these scenario types; "DS, other '
        "types\" for types drawn anew. SR p: McNemar's exact test",
        ".",
    ]
    # several comparisons: the correction, and its limits
    if len(found) > 1:
        notes[1] = (
            f", corrected for {len(found)} comparisons (Holm). Each interval is a 95 % "
            "interval by itself: one in twenty misses zero by chance where nothing "
            "differs."
        )
    # what so few routes cannot show
    if found:
        n, least = found[0].driving_score.n, found[0].smallest_shown
        on = counted(n, "route")
        notes.append(f" {on} cannot show a difference below {least:.1f} points.")
    alike = [each for each in found if not each.differ]
    if alike:
        routes, share = alike[0].driving_score.n, alike[0].unseen_percent
        notes.append(
            f" Where 0 of {routes} routes differ, at most {share:.1f} % do (95 %)."
        )
    return "".join(notes)


def abilities(outcome: "StudyResult") -> tuple[Table, ...]:
    """Show the success rate by ability, in tables like the scoreboards."""
    if len(outcome.variants) > 1:
        return tuple(
            _abilities(
                f"Success by ability in %, {_condition(outcome, each)}",
                {drive.variant: drive.scores for drive in outcome.under(each)},
                outcome.study.baseline,
            )
            for each in outcome.study.conditions
        )
    found = {drive.condition: drive.scores for drive in outcome.drives}
    title = f"Success of {outcome.study.baseline} by ability in %"
    return (_abilities(title, found, "", "condition"),)


def _abilities(
    title: str,
    found: Mapping[str, Scores | None],
    strong: str,
    heading: str = "variant",
) -> Table:
    rows = [
        (
            Cell(name),
            *map(estimate_cell, (*scores.each_ability.values(), scores.abilities)),
        )
        for name, scores in found.items()
        if scores is not None
    ]
    return Table(
        title,
        (heading, *(name.replace("_", " ") for name in ABILITIES), "mean"),
        tuple(rows),
        "A route may test two abilities. Intervals are exact, the mean's by bootstrap.",
        strong,
    )


def change_tables(outcome: "StudyResult") -> tuple[Table, ...]:
    """Show costs of changed conditions, and pairs of drives, if there are any."""
    # changes of a condition, and pairs of drives
    baseline = outcome.study.baseline
    found = outcome.changes, outcome.pairs
    titles = (
        f"One change, the same routes and seeds; more than it costs {baseline}?",
        "Pairs of drives on the same routes",
    )
    note = (
        "The first drive minus the second, mean over routes with its 95 % interval: one"
        " that holds zero shows no difference."
    )
    further = (
        f" Beyond: minus {baseline}'s own difference, route by route; below zero where"
        " the change costs more than it."
    )
    # only changes have the columns beyond the baseline
    columns = ("drive", "against", "DS, points", "DS, other types", "SR, points")
    return tuple(
        Table(
            title,
            (*columns, "DS beyond", "SR beyond")[: len(columns) + 2 * beyond],
            tuple(_change(each, beyond=beyond) for each in rows),
            note + further if beyond else note,
        )
        for title, rows, beyond in zip(titles, found, (True, False), strict=True)
        if rows
    )


def _change(change: "Change", *, beyond: bool) -> tuple[Cell, ...]:
    score = change.driving_score
    cells = (
        Cell(change.drive),
        Cell(change.against),
        estimate_cell(score, signed=True),
        between_cell(score.anew_low, score.anew_high, "+.1f"),
        estimate_cell(change.success_rate, signed=True),
    )
    own = Cell(MISSING, reason="the baseline itself")
    rest = (change.beyond_driving_score, change.beyond_success_rate)
    shown = (own if each is None else estimate_cell(each, signed=True) for each in rest)
    return (*cells, *shown) if beyond else cells


def _scores(drive: Drive) -> tuple[Cell, ...]:
    if drive.scores is None:
        return (Cell(MISSING, reason=drive.reason),) * 4
    scores = drive.scores
    shown = (scores.driving_score, scores.success_rate, scores.efficiency)
    return (*map(estimate_cell, shown), estimate_cell(scores.comfort))


def _costs(variant: "VariantOutcome") -> tuple[Cell, ...]:
    return (
        measure_cell(variant.size_mb, ".2f"),
        measure_cell(variant.latency_ms[50], ".1f"),
        measure_cell(variant.latency_ms[99], ".1f"),
        measure_cell(variant.fidelity.mean_m, ".3f"),
        measure_cell(variant.fidelity.plan_sqnr_db, ".1f"),
    )


def _difference(found: PairedDifference, p_value: float) -> tuple[Cell, ...]:
    score = found.driving_score
    return (
        estimate_cell(score, signed=True),
        between_cell(score.anew_low, score.anew_high, "+.1f"),
        estimate_cell(found.success_rate, signed=True),
        Cell(f"{p_value:.2g}"),
        Cell(str(found.better)),
        Cell(str(found.worse)),
    )


def _condition(outcome: "StudyResult", condition: Condition) -> str:
    scale = outcome.device_scale
    device = "this machine" if scale == 1.0 else f"a device {scale:.3g} times slower"
    return condition.described(device)


def _routes_note(outcome: "StudyResult") -> str:
    driven, whole = outcome.coverage
    of = "" if driven == whole else f"{driven} of "
    share = f"{of}{counted(whole, 'route')}"
    return (
        f"{share}. DS driving score, SR success rate, DE efficiency, DC comfort, each "
        f"with its 95 % interval over these scenario types. {MISSING} means not "
        "measured."
    )


def _costs_note(outcome: "StudyResult") -> str:
    notes = []
    if outcome.timed:
        kind = "on this machine"
        if outcome.device_scale != 1.0:
            kind = f"times {outcome.device_scale:.3g}, one device scale for all"
        notes.append(f"Latency: models in turn, warm, {kind}.")
    notes.append(
        f"Plan and SQNR: how far waypoints move from {outcome.study.baseline}'s on "
        "held-out frames, and the noise on them."
    )
    return " ".join(notes)


def estimate_cell(
    estimate: Estimate, form: str = ".1f", *, signed: bool = False
) -> Cell:
    """Show a mean with its interval."""
    measure, sign = estimate.measure, "+" if signed else ""
    if measure.value is None:
        return Cell(MISSING, reason=measure.reason)
    form = f"{sign}{'.3f' if measure.unit == 'ratio' else form}"
    text = number(measure.value, form)
    if estimate.low is None or estimate.high is None:
        return Cell(text)
    low, high = (number(each, form) for each in (estimate.low, estimate.high))
    return Cell(text, f"{low} to {high}")


def between_cell(low: float | None, high: float | None, form: str) -> Cell:
    """Show an interval alone."""
    if low is None or high is None:
        return Cell(MISSING, reason="too few scenario types")
    return Cell(f"{number(low, form)} to {number(high, form)}")


def measure_cell(measure: Measure, form: str) -> Cell:
    """Show a number, or a dash with its reason."""
    if measure.value is None:
        infinite = measure.reason == EXACT
        return Cell(INFINITE if infinite else MISSING, reason=measure.reason)
    return Cell(number(measure.value, form))


def number(value: float, form: str) -> str:
    """Format a number with a true minus sign and no negative zero."""
    return plain_number(value, form).replace("-", MINUS)
