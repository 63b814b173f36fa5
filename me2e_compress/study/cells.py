"""Cells of tables: a number with its interval, or a dash that knows why."""

from me2e_compress.metrics.measure import Estimate, Measure
from me2e_compress.study.plan_fidelity import EXACT
from me2e_compress.workflows.result import Cell

MISSING = "\N{EN DASH}"
"""Stands where nothing was measured."""
INFINITE = "\N{INFINITY}"
MINUS = "\N{MINUS SIGN}"


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
