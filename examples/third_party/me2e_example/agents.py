"""A latency that grows with the road users in view."""

from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.latency import (
    DecisionFacts,
    LatencySource,
    LayeredLatency,
    NoLatency,
)


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
        EvaluationError: In a drive, the simulator does not tell where others are.
    """

    name: ClassVar[str] = "agents"
    source: LatencySource = field(default_factory=NoLatency)
    per_agent_us: Annotated[int, Field(ge=0)] = 3000
    range_m: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] = 50.0
    fov_deg: Annotated[float, Field(gt=0.0, le=360.0)] = 360.0

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
