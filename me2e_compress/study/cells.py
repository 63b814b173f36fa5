"""Cells and tables: a number with its interval, or a dash that knows why."""

from collections.abc import Iterable
from dataclasses import dataclass

from me2e_compress.metrics.measure import Estimate, Measure
from me2e_compress.study.plan_fidelity import EXACT

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


def _line(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _plain(cell: Cell) -> str:
    text = cell.text.replace("|", "\\|")
    return f"{text} ({cell.detail})" if cell.detail else text
