"""A table of deadlines, of a latency trace or of an evaluation's decisions."""

from collections.abc import Iterator

from me2e_compress.errors import EvaluationError
from me2e_compress.metrics.deadlines import Deadlines
from me2e_compress.metrics.measure import Measure
from me2e_compress.workflows.result import Table, counted, not_measured, number, table


def deadlines_table(title: str, found: Deadlines) -> Table:
    """Return percentiles, and how many decisions took longer than the budget."""
    rows = [(n, number(each.value, ".2f"), each.unit) for n, each in _each(found)]
    why = {name: each.reason for name, each in _each(found) if each.value is None}
    return table(
        f"{title}: {counted(found.count, 'decision')}",
        ("latency", "", "unit"),
        rows,
        not_measured(why),
    )


def check_budget(budget_ms: float) -> None:
    """Raise EvaluationError unless the budget of a decision is a positive number."""
    if not 0.0 < budget_ms < float("inf"):
        raise EvaluationError(f"--budget-ms {budget_ms:g}: must be a positive number")


def _each(found: Deadlines) -> Iterator[tuple[str, Measure]]:
    yield from ((f"p{p:g}", each) for p, each in found.percentiles_ms.items())
    yield "max", found.worst_ms
    yield "mean", found.mean_ms
    yield f"over {found.budget_ms:g} ms", found.over_percent
    if found.critical_ms.value is not None:
        yield "mean, TTC below 1.5 s", found.critical_ms
        yield "mean, other frames", found.other_ms
