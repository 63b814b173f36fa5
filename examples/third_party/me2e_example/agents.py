"""A latency that grows with the road users in view."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from me2e_compress.driving.latency import (
    DecisionFacts,
    LatencySource,
    LayeredLatency,
    NoLatency,
    check_positive,
)
from me2e_compress.errors import EvaluationError


@dataclass(frozen=True)
class AgentsLatency(LayeredLatency):
    """Another source's latency plus a constant for every road user in view.

    Jitter is that of the source below: a trace has its own.

    Attributes:
        source: The latency without anybody in view: another source, or its text.
        per_agent_us: Microseconds for each road user in view.
        range_m: How far the policy looks, from the centre of the ego to theirs.
        fov_deg: Field of view, half of it on each side of straight ahead; 360 is all
            round, as six cameras look.

    Raises:
        EvaluationError: An option is out of its range; in a drive, the simulator does
            not tell where others are.
    """

    name: ClassVar[str] = "agents"
    source: LatencySource = field(default_factory=NoLatency)
    per_agent_us: int = 3000
    range_m: float = 50.0
    fov_deg: float = 360.0

    def __post_init__(self) -> None:
        if self.per_agent_us < 0:
            raise EvaluationError(
                f"latency agents: per_agent_us {self.per_agent_us}: must be 0 or more"
            )
        check_positive("agents: range_m", self.range_m)
        if not 0.0 < self.fov_deg <= 360.0:
            raise EvaluationError(
                f"latency agents: fov_deg {self.fov_deg:g}: above 0, at most 360"
            )

    def layered(self, latency_us: int, facts: DecisionFacts) -> int:
        """Charge for the road users in view."""
        return latency_us + self.per_agent_us * self.in_view(facts)

    def in_view(self, facts: DecisionFacts) -> int:
        """Count the road users within range and field of view."""
        if facts.agents_m is None:
            raise EvaluationError(
                "latency agents: what drives here does not tell where others are"
            )
        # within range and field of view
        x, y = facts.agents_m.T
        near = np.hypot(x, y) <= self.range_m
        ahead = np.abs(np.arctan2(y, x)) <= np.radians(self.fov_deg) / 2
        return int(np.count_nonzero(near & ahead))
