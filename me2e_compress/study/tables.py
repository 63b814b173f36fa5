"""The tables of a study: one content for the terminal, Markdown and HTML."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from me2e_compress.metrics.differences import Difference
from me2e_compress.metrics.measure import Estimate, Measure
from me2e_compress.study.definition import Condition
from me2e_compress.study.drives import Drive
from me2e_compress.study.fidelity import EXACT
from me2e_compress.study.outcome import Outcome, SchemeOutcome

MISSING = "\N{EN DASH}"
"""Stands where nothing was measured."""
INFINITE = "\N{INFINITY}"
MINUS = "\N{MINUS SIGN}"


@dataclass(frozen=True)
class Cell:
    """A number as it is shown.

    Attributes:
        text: The number, or words.
        detail: Its interval, in smaller type; empty if it has none.
        reason: Why there is no number; empty if there is one.
    """

    text: str
    detail: str = ""
    reason: str = ""


@dataclass(frozen=True)
class Table:
    """Rows of one thing each: the first column is its name, the others are numbers.

    Attributes:
        title: Heads it.
        columns: With their units.
        rows: As wide as the columns.
        note: What a reader must know; one or two sentences.
        strong: Name of the row that the others are held against.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""
    strong: str = ""

    def markdown(self) -> str:
        """Write it as GitHub shows it, intervals in brackets."""
        rule = "|---|" + "---:|" * (len(self.columns) - 1)
        lines = [_line(self.columns), rule, *(_line(map(_plain, r)) for r in self.rows)]
        parts = [f"**{self.title}**", "\n".join(lines), *filter(None, [self.note])]
        return "\n\n".join(parts) + "\n"


def scoreboards(outcome: Outcome) -> tuple[Table, ...]:
    """Show how every scheme drives, and what it weighs and takes.

    One table a condition; one scheme alone has one table of all its conditions.
    """
    conditions = outcome.study.conditions
    if len(outcome.schemes) > 1:
        return tuple(
            _scoreboard(
                outcome,
                f"Scoreboard, {_condition(outcome, each)}",
                ("scheme", [drive.scheme for drive in outcome.under(each)]),
                outcome.under(each),
            )
            for each in conditions
        )
    names = [condition.name for condition in conditions]
    title = f"Scoreboard of {outcome.study.baseline}"
    return (_scoreboard(outcome, title, ("condition", names), outcome.drives),)


def _scoreboard(
    outcome: Outcome,
    title: str,
    first: tuple[str, Sequence[str]],
    drives: Sequence[Drive],
) -> Table:
    heading, names = first
    return Table(
        title,
        (
            *(heading, "DS", "SR %", "DE %", "DC"),
            *("size MB", "p50 ms", "p99 ms", "plan m", "SQNR dB"),
        ),
        tuple(
            (Cell(name), *_scores(drive), *_costs(outcome.scheme(drive.scheme)))
            for name, drive in zip(names, drives, strict=True)
        ),
        _scoreboard_note(outcome),
        outcome.study.baseline,
    )


def differences(outcome: Outcome) -> Table:
    """Show every scheme minus the baseline, paired by route."""
    baseline, rows = outcome.study.baseline, []
    several = len(outcome.study.conditions) > 1
    for drive in outcome.drives:
        if drive.difference is None:
            continue
        name = f"{drive.scheme}, {drive.condition}" if several else drive.scheme
        rows.append((Cell(name), *_difference(drive.difference)))
    return Table(
        f"Difference to {baseline} on the same routes",
        ("scheme", "DS, points", "SR, points", "routes better", "routes worse"),
        tuple(rows),
        "Mean over routes with its 95 % interval, paired bootstrap: an interval that "
        "holds zero shows no difference.",
    )


def abilities(outcome: Outcome, condition: Condition) -> Table:
    """Show the success rate by ability."""
    drives = [each for each in outcome.under(condition) if each.scores is not None]
    names = list(drives[0].scores.each_ability) if drives and drives[0].scores else []
    rows = []
    for drive in drives:
        if drive.scores is None:
            continue
        each = [estimate_cell(drive.scores.each_ability[name]) for name in names]
        mean = estimate_cell(drive.scores.abilities)
        rows.append((Cell(drive.scheme), *each, mean))
    return Table(
        f"Success by ability in %, {_condition(outcome, condition)}",
        ("scheme", *(name.replace("_", " ") for name in names), "mean"),
        tuple(rows),
        "A route may test two abilities. Brackets: exact 95 % interval.",
        outcome.study.baseline,
    )


def all_tables(outcome: Outcome) -> tuple[Table, ...]:
    """Every table of a study, in the order of reading."""
    conditions = outcome.study.conditions
    compared = [differences(outcome)] if len(outcome.schemes) > 1 else []
    return (
        *scoreboards(outcome),
        *compared,
        *(abilities(outcome, each) for each in conditions),
    )


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


def measure_cell(measure: Measure, form: str) -> Cell:
    """Show a number, or a dash that knows why."""
    if measure.value is None:
        infinite = measure.reason == EXACT
        return Cell(INFINITE if infinite else MISSING, reason=measure.reason)
    return Cell(number(measure.value, form))


def number(value: float, form: str) -> str:
    """Write a number with a minus as wide as a plus, and no negative zero."""
    text = format(value, form)
    if not any(digit in text for digit in "123456789"):
        text = text.replace("-", "+" if form.startswith("+") else "")
    return text.replace("-", MINUS)


def _scores(drive: Drive) -> tuple[Cell, ...]:
    if drive.scores is None:
        return (Cell(MISSING, reason=drive.reason),) * 4
    scores = drive.scores
    shown = (scores.driving_score, scores.success_rate, scores.efficiency)
    return (*map(estimate_cell, shown), estimate_cell(scores.comfort))


def _costs(scheme: SchemeOutcome) -> tuple[Cell, ...]:
    return (
        measure_cell(scheme.size_mb, ".2f"),
        measure_cell(scheme.latency_ms[50], ".1f"),
        measure_cell(scheme.latency_ms[99], ".1f"),
        measure_cell(scheme.fidelity.mean_m, ".3f"),
        measure_cell(scheme.fidelity.plan_sqnr_db, ".1f"),
    )


def _difference(found: Difference) -> tuple[Cell, ...]:
    return (
        estimate_cell(found.driving_score, signed=True),
        estimate_cell(found.success_rate, signed=True),
        Cell(str(found.better)),
        Cell(str(found.worse)),
    )


def _condition(outcome: Outcome, condition: Condition) -> str:
    if condition.latency == "none":
        return f"{condition.name}: decisions cost no time"
    if not condition.traced:
        fps = condition.latency.removeprefix("fps:")
        return f"{condition.name}: {fps} decisions a second"
    scale = outcome.device_scale
    device = "this machine" if scale == 1.0 else f"a device {scale:.2f} times slower"
    return f"{condition.name}: each model's own latency, {device}"


def _scoreboard_note(outcome: Outcome) -> str:
    study = outcome.study
    driven, whole = len(study.routes), study.set_size
    share = f"{driven} routes" if driven == whole else f"{driven} of {whole} routes"
    notes = [
        f"{share}. DS driving score, SR success rate, DE efficiency, DC comfort, each "
        "with its 95 % interval."
    ]
    if outcome.timed:
        kind = "on this machine"
        if outcome.device_scale != 1.0:
            kind = f"x {outcome.device_scale:.2f}, one device scale for all"
        notes.append(f"Latency: measured here in turn, warm, {kind}.")
    notes.append(
        f"Plan and SQNR: how far waypoints move from {study.baseline}'s on held-out "
        "frames, and the noise on them. "
        f"{MISSING} means not measured."
    )
    return " ".join(notes)


def _line(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _plain(cell: Cell) -> str:
    text = cell.text.replace("|", "\\|")
    return f"{text} ({cell.detail})" if cell.detail else text
