"""Share of decisions that exceed their latency budget."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from me2e_compress.base.display import Table, format_number, missing_note, plural, table
from me2e_compress.metrics import BUDGET_MS
from me2e_compress.metrics.episode import Episode
from me2e_compress.metrics.measure import Measure, percentile, too_few

PERCENTILES = {f"p{percent:g}_ms": percent for percent in (50.0, 99.0, 99.9)}


@dataclass(frozen=True, slots=True)
class Deadlines:
    """Latencies compared with a budget."""

    budget_ms: float
    count: int
    # By name: the percentiles, which have no value if too few samples were measured for
    # them, `mean_ms`, `max_ms`, `over_budget_percent`
    measures: Mapping[str, Measure]

    def to_json(self) -> dict[str, Any]:
        """Return plain numbers, null for what was not measured."""
        values = {name: measure.value for name, measure in self.measures.items()}
        return {"budget_ms": self.budget_ms, "decisions": self.count, **values}


def deadlines(
    latencies_us: Sequence[int],
    budget_ms: float = BUDGET_MS,
    measured: int | None = None,
) -> Deadlines:
    """Compare latencies with a budget; a latency of exactly the budget is in time.

    ``measured`` is the number of samples in the trace that the latencies were drawn
    from; None if each was measured on its own.
    """
    # A percentile needs enough samples of its own
    count = len(latencies_us)
    none, measures = "" if count else "no decision was taken", dict[str, Measure]()
    samples = count if measured is None else min(count, measured)
    for name, percent in PERCENTILES.items():
        why = none or too_few(percent, samples)
        value = None if why else percentile(latencies_us, percent) / 1e3
        measures[name] = Measure(value, "ms", why)
    # The mean, the largest, and the share that is late
    late = sum(latency_us > 1e3 * budget_ms for latency_us in latencies_us)
    values = {
        "mean_ms": (fmean(latencies_us) / 1e3 if count else None, "ms"),
        "max_ms": (max(latencies_us) / 1e3 if count else None, "ms"),
        "over_budget_percent": (100.0 * late / count if count else None, "%"),
    }
    measures |= {name: Measure(*own, none) for name, own in values.items()}
    return Deadlines(budget_ms, count, measures)


def charged_deadlines(
    episodes: Iterable[Episode],
    budget_ms: float = BUDGET_MS,
    measured: int | None = None,
) -> Deadlines | None:
    """Compare the latencies of episodes with a budget; None if all are zero."""
    latencies = [
        decision.latency_us for episode in episodes for decision in episode.decisions
    ]
    return deadlines(latencies, budget_ms, measured) if any(latencies) else None


def deadlines_table(title: str, deadlines: Deadlines) -> Table:
    """Return percentiles, and how many decisions took longer than the budget."""
    names = {name: f"p{percent:g}" for name, percent in PERCENTILES.items()}
    names |= {"max_ms": "max", "mean_ms": "mean"}
    names["over_budget_percent"] = f"over {deadlines.budget_ms:g} ms"
    shown = {words: deadlines.measures[name] for name, words in names.items()}
    why = {words: e.reason for words, e in shown.items() if e.value is None}
    return table(
        f"{title}: {plural(deadlines.count, 'decision')}",
        ("latency", "", "unit"),
        [(words, format_number(e.value, ".2f"), e.unit) for words, e in shown.items()],
        missing_note(why),
    )
