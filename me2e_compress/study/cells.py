"""Cells of a study's tables: one content for the terminal, Markdown and HTML."""

from me2e_compress.base.display import Cell, format_number
from me2e_compress.metrics.measure import FEWEST_TYPES, Estimate, Measure

MISSING = "\N{EN DASH}"  # shown if nothing was measured
INFINITE = "\N{INFINITY}"
MINUS = "\N{MINUS SIGN}"
# Reason why an unchanged plan has no signal-to-noise ratio
EXACT = "no noise: equal to the bit"


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
    return Cell(text, f"{number(estimate.low, form)} to {number(estimate.high, form)}")


def redrawn_cell(estimate: Estimate) -> Cell:
    """Show a difference's interval over scenario types drawn anew, without its mean."""
    low, high = estimate.anew_low, estimate.anew_high
    if low is None or high is None:
        return Cell(MISSING, reason=f"fewer than {FEWEST_TYPES} scenario types")
    return Cell(f"{number(low, '+.1f')} to {number(high, '+.1f')}")


def measure_cell(measure: Measure, form: str) -> Cell:
    """Show a number, or a dash with its reason."""
    if measure.value is None:
        infinite = measure.reason == EXACT
        return Cell(INFINITE if infinite else MISSING, reason=measure.reason)
    return Cell(number(measure.value, form))


def number(value: float, form: str) -> str:
    """Format a number with a true minus sign and no negative zero."""
    return format_number(value, form).replace("-", MINUS)
