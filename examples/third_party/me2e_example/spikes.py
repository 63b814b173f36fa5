"""A latency that is short but for a spike now and then."""

import itertools
from dataclasses import dataclass
from typing import Any, ClassVar

from me2e_compress.driving.latency import Charge, DecisionFacts, LatencySource


@dataclass(frozen=True)
class Spikes(LatencySource):
    """Every so many decisions, one takes long.

    Attributes:
        usual_ms: what a decision takes, milliseconds.
        spike_ms: what every ``every``-th takes.
        every: decisions from one spike to the next.
    """

    name: ClassVar[str] = "spikes"
    usual_ms: float = 50.0
    spike_ms: float = 400.0
    every: int = 10

    def on_route(self, route: str) -> Charge:
        """Count the decisions of one route from its first."""
        count = itertools.count(1)

        def charge(facts: DecisionFacts) -> int:
            spike = next(count) % self.every == 0
            return round(1e3 * (self.spike_ms if spike else self.usual_ms))

        return charge

    def to_json(self) -> dict[str, Any]:
        """Return what decides the latencies."""
        return {
            "usual_ms": self.usual_ms,
            "spike_ms": self.spike_ms,
            "every": self.every,
        }
