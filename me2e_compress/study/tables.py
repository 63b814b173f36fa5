"""Tables of a study, in reading order."""

from collections.abc import Mapping, Sequence

from me2e_compress.display import Cell, Table, counted
from me2e_compress.metrics.bench2drive import ABILITIES
from me2e_compress.metrics.route_summary import (
    COLUMNS,
    PairedDifference,
    RouteSummary,
    holm,
)
from me2e_compress.metrics.scores import Scores
from me2e_compress.study.cells import MISSING, anew_cell, estimate_cell, measure_cell
from me2e_compress.study.changes import Change
from me2e_compress.study.condition import Condition
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.outcome import StudyOutcome, VariantOutcome

SCORES = tuple(each.name for each in COLUMNS)
MOST_ROUTES = 40
"""With more routes than this, the table of endings is left out."""
COSTS = ("size MB", "p50 ms", "p99 ms", "plan m", "SQNR dB")


def scoreboards(outcome: StudyOutcome) -> tuple[Table, ...]:
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


def _scoreboard(outcome: StudyOutcome, condition: Condition) -> Table:
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


def differences(outcome: StudyOutcome) -> Table:
    """Show every variant minus the baseline, paired by route."""
    # drives with a difference to the baseline
    compared = [
        (outcome.label(drive), drive.difference)
        for drive in outcome.drives
        if drive.difference is not None
    ]
    found = [each for _, each in compared]
    # p-values are corrected for all comparisons shown
    corrected = holm([each.p_value for each in found])
    return Table(
        f"Difference to {outcome.study.baseline} on the same routes",
        (
            *("variant", "DS, points", "DS, other types", "room, points"),
            *("SR, points", "SR p", "routes better", "routes worse"),
        ),
        tuple(
            (Cell(name), *_difference(each, p))
            for (name, each), p in zip(compared, corrected, strict=True)
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


def abilities(outcome: StudyOutcome) -> tuple[Table, ...]:
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


def change_tables(outcome: StudyOutcome) -> tuple[Table, ...]:
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
    columns = (
        *("drive", "against", "DS, points", "DS, other types", "room, points"),
        "SR, points",
    )
    more = ("DS beyond", "room beyond", "SR beyond")
    return tuple(
        Table(
            title,
            (*columns, *more) if beyond else columns,
            tuple(_change(each, beyond=beyond) for each in rows),
            note + further if beyond else note,
        )
        for title, rows, beyond in zip(titles, found, (True, False), strict=True)
        if rows
    )


def _change(change: Change, *, beyond: bool) -> tuple[Cell, ...]:
    cells = (
        Cell(change.drive),
        Cell(change.against),
        *_gaps(change),
    )
    own = Cell(MISSING, reason="the baseline itself")
    rest = (
        *(change.beyond_driving_score, change.beyond_room_kept),
        change.beyond_success_rate,
    )
    shown = (own if each is None else estimate_cell(each, signed=True) for each in rest)
    return (*cells, *shown) if beyond else cells


def _gaps(of: Change | PairedDifference) -> tuple[Cell, Cell, Cell, Cell]:
    """Show differences: driving score with both intervals, room kept, success rate."""
    score, room, rate = (
        estimate_cell(each, signed=True)
        for each in (of.driving_score, of.room_kept, of.success_rate)
    )
    return score, anew_cell(of.driving_score), room, rate


def route_table(outcome: StudyOutcome) -> Table | None:
    """Show how each route ended for each driver; None if there are too many routes."""
    driven = [each for each in outcome.drives if each.routes]
    if not driven or len(driven[0].routes) > MOST_ROUTES:
        return None
    # one column per drive, one row per route
    names = map(outcome.label, driven)
    return Table(
        "How each route ended",
        ("route", *names),
        tuple(
            (
                Cell(routes[0].route),
                *(Cell(f"{each.driving_score:.1f}", _ended(each)) for each in routes),
            )
            for routes in zip(*(each.routes for each in driven), strict=True)
        ),
        "Driving score, why it is not 100, and the room kept to others.",
    )


def _ended(route: RouteSummary) -> str:
    room = route.room_kept
    return route.fate if room is None else f"{route.fate}; room {room:.0f} %"


def _scores(drive: DriveRecord) -> tuple[Cell, ...]:
    if drive.scores is None:
        return (Cell(MISSING, reason=drive.reason),) * len(SCORES)
    found = drive.scores
    shown = (
        *(found.driving_score, found.safety.room_kept, found.success_rate),
        *(found.efficiency, found.bench2drive_efficiency),
        *(found.comfort, found.bench2drive_smoothness),
    )
    return tuple(map(estimate_cell, shown))


def _costs(variant: VariantOutcome) -> tuple[Cell, ...]:
    return (
        measure_cell(variant.size_mb, ".2f"),
        measure_cell(variant.latency_ms[50], ".1f"),
        measure_cell(variant.latency_ms[99], ".1f"),
        measure_cell(variant.fidelity.mean_m, ".3f"),
        measure_cell(variant.fidelity.plan_sqnr_db, ".1f"),
    )


def _difference(found: PairedDifference, p_value: float) -> tuple[Cell, ...]:
    return (
        *_gaps(found),
        Cell(f"{p_value:.2g}"),
        Cell(str(found.better)),
        Cell(str(found.worse)),
    )


def _condition(outcome: StudyOutcome, condition: Condition) -> str:
    scale = outcome.device_scale
    device = "this machine" if scale == 1.0 else f"a device {scale:.3g} times slower"
    return condition.described(device)


def _routes_note(outcome: StudyOutcome) -> str:
    driven, whole = outcome.coverage
    of = "" if driven == whole else f"{driven} of "
    share = f"{of}{counted(whole, 'route')}"
    return (
        f"{share}. DS driving score, room kept to others, SR success rate, DE"
        " efficiency, DC comfort, both also in the arithmetic of Bench2Drive's tools"
        " (b2d), each "
        f"with its 95 % interval over these scenario types. {MISSING} means not "
        "measured."
    )


def _costs_note(outcome: StudyOutcome) -> str:
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
