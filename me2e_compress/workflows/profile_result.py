"""Latencies of one model, and its joules, as they are shown."""

import dataclasses
from pathlib import Path

from me2e_compress.metrics.deadlines import BUDGET_MS, Deadlines, deadlines
from me2e_compress.runtime.energy import EnergyResult
from me2e_compress.runtime.latency_trace import (
    LatencyTrace,
    Microseconds,
    shares,
    shares_table,
)
from me2e_compress.workflows.deadlines_table import deadlines_table
from me2e_compress.workflows.result import Result, Table

_SHOWN = 12
"""Number of operators in a table."""
BEYOND_P99 = 5
"""Samples beyond the 99th percentile from which on it is steady: with fewer, one
disturbance more or less moves it.
"""


@dataclasses.dataclass(frozen=True, repr=False)
class ProfileResult(Result):
    """Latencies of one model.

    Attributes:
        operators_us: microseconds of each operator, in inferences under a profiler.
        energy: joules, or why there are none; None if not asked for.
        told: other readings, in words, such as the power of a device.
        slow_here: why the file is slow on this CPU, whose form is not its own.
    """

    model: Path
    trace: LatencyTrace
    output: Path | None
    operators_us: Microseconds = dataclasses.field(default_factory=dict)
    figure: Path | None = None
    energy: EnergyResult | None = None
    energy_output: Path | None = None
    budget_ms: float = BUDGET_MS
    told: tuple[str, ...] = ()
    slow_here: str | None = None

    @property
    def deadlines(self) -> Deadlines:
        """The samples held against the budget."""
        return deadlines(self.trace.samples_us, self.budget_ms)

    @property
    def headline(self) -> str:
        """The file, the number of inferences and the machine."""
        return f"{self.output or self.model.name}: {self.trace.headline}"

    def lines(self) -> tuple[str, ...]:
        """Return how far the last percentile can be trusted, and the joules."""
        energy = () if self.energy is None else (self.energy.headline,)
        energy = (*self.told, *energy)
        count, needed = len(self.trace.samples_us), 100 * BEYOND_P99
        if count >= needed:
            return energy
        return (
            *energy,
            f"p99 is steady from {needed} samples on, with {BEYOND_P99} beyond it; here"
            f" are {count}{self._remedy(needed)}",
        )

    def _remedy(self, needed: int) -> str:
        return "" if self.trace.others is None else f" (--samples {needed})"

    def alerts(self) -> tuple[str, ...]:
        """Return what puts joules and times in doubt, and a form that is slow here."""
        energy = () if self.energy is None else self.energy.alerts()
        load = self.trace.others
        busy = str(load) if load is not None and load.busy else None
        slow = self.slow_here and f"{self.model.name}: {self.slow_here}"
        return (*energy, *filter(None, (busy, slow)))

    def tables(self) -> tuple[Table, ...]:
        """Return percentiles in milliseconds, then modules, energy and operators."""
        whole, *modules = self.trace.tables()
        energy = () if self.energy is None else self.energy.tables()
        late = deadlines_table("Against the budget", self.deadlines)
        whole = dataclasses.replace(whole, title=self.headline)
        found = (whole, late, *modules, *energy)
        if not self.operators_us:
            return found
        # of many operators the first are shown, with a note on the others
        rest = len(self.operators_us) - _SHOWN
        shown = shares_table("By operator, as it runs", "operator", self.operators_us)
        more = f"{rest} more operators: --json" if rest > 0 else ""
        note = "; ".join(filter(None, (shown.note, more)))
        return *found, dataclasses.replace(shown, rows=shown.rows[:_SHOWN], note=note)

    def to_json(self) -> object:
        """Return the trace, deadlines, shares, joules, and how busy the machine was."""
        load = self.trace.others
        return {
            **self.trace.to_json(),
            "deadlines": self.deadlines.to_json(),
            "modules": shares(self.trace.modules_us),
            "operators": shares(self.operators_us),
            "energy": self.energy,
            "slow_here": self.slow_here,
            **(
                {"others_cores": None, "cores": None}
                if load is None
                else load.to_json()
            ),
        }
