"""Latencies made of others: held to a frame rate, or longer where there is more to do.

A spike in a critical frame is what hurts (the paper's finding on multi-frame
stability), and a trace that is drawn without regard to the scene has its spikes
anywhere. These sources put them where the work is; they draw nothing, so what they are
made of decides whether a drive is reproducible.
"""

import abc
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from me2e_compress.driving.latency_source import (
    Charge,
    DecisionFacts,
    LatencySource,
    check_positive,
)
from me2e_compress.errors import EvaluationError

__all__ = ["AgentsLatency", "HostStageLatency", "LayeredLatency", "LimitedLatency"]


@dataclass(frozen=True)
class LayeredLatency(LatencySource):
    """A source on top of another: derive a frozen dataclass with further options.

    Attributes:
        source: What it adds to: another source, or its text.
    """

    source: LatencySource

    @abc.abstractmethod
    def layered(self, latency_us: int, facts: DecisionFacts) -> int:
        """Return the microseconds that a decision takes in all.

        Args:
            latency_us: What the source below says.
            facts: What is known of the decision.
        """

    @property
    def measures(self) -> bool:  # type: ignore[override]
        """Whether the source below depends on this machine, now."""
        return self.source.measures

    @property
    def measured(self) -> int | None:
        """How many measurements the source below draws from."""
        return self.source.measured

    @property
    def lacks_trace(self) -> bool:
        """Whether the source below stands for each model's own latencies."""
        return self.source.lacks_trace

    def with_trace(self, samples_us: tuple[int, ...], scale: float) -> Self:
        """Give the source below the latencies of a model."""
        return replace(self, source=self.source.with_trace(samples_us, scale))

    def on_route(self, route: str) -> Charge:
        """Start the clock of the source below, and add to it."""
        below = self.source.on_route(route)
        return lambda facts: self.layered(below(facts), facts)


@dataclass(frozen=True)
class LimitedLatency(LayeredLatency):
    """A frame limiter: max(latency, 1 / fps).

    Attributes:
        source: What is limited: another source, or its text.
        fps: The most decisions a second.

    Raises:
        EvaluationError: A rate that is not positive.
    """

    name: ClassVar[str] = "limited"
    fps: float

    def __post_init__(self) -> None:
        """Check the rate."""
        check_positive("limited: fps", self.fps)

    def layered(self, latency_us: int, facts: DecisionFacts) -> int:
        """Charge no less than the period."""
        return max(latency_us, round(1e6 / self.fps))

    def to_json(self) -> dict[str, Any]:
        """Return the period in microseconds, and what is limited."""
        return {"limit_us": round(1e6 / self.fps), "of": self.source.to_json()}


@dataclass(frozen=True)
class AgentsLatency(LayeredLatency):
    """Another source's latency, and so much more for every road user in view.

    Jitter is that of the source below: a trace has its own.

    Attributes:
        source: What a decision takes without anybody in view.
        per_agent_us: Microseconds for each of them.
        range_m: How far the policy looks, from the centre of the ego to theirs.
        fov_deg: Field of view, half of it on each side of straight ahead; 360 is all
            round, as six cameras look.

    Raises:
        EvaluationError: A negative cost, a range that is not positive, or a field of
            view of nothing or of more than a circle; in a drive, a simulator that does
            not tell where others are.
    """

    name: ClassVar[str] = "agents"
    per_agent_us: int
    range_m: float = 50.0
    fov_deg: float = 360.0

    def __post_init__(self) -> None:
        """Check the options."""
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
        """Charge for those in view."""
        return latency_us + self.per_agent_us * self.in_view(facts)

    def in_view(self, facts: DecisionFacts) -> int:
        """Count the road users within range and field of view.

        Raises:
            EvaluationError: The simulator does not tell where they are.
        """
        if facts.agents_m is None:
            raise EvaluationError(
                "latency agents: what drives here does not tell where others are"
            )
        x, y = facts.agents_m.T
        near = np.hypot(x, y) <= self.range_m
        ahead = np.abs(np.arctan2(y, x)) <= np.radians(self.fov_deg) / 2
        return int(np.count_nonzero(near & ahead))

    def to_json(self) -> dict[str, Any]:
        """Return the options, and what is added to."""
        return {
            "per_agent_us": self.per_agent_us,
            "range_m": self.range_m,
            "fov_deg": self.fov_deg,
            "of": self.source.to_json(),
        }


@dataclass(frozen=True)
class HostStageLatency(LayeredLatency):
    """Another source's latency, and what a policy's host stage takes beside it.

    For a trace or a rate that knows the network alone. It charges what the stage did,
    not what the clock here says: such a drive is the same everywhere.

    Attributes:
        source: What the network takes.
        per_iteration_us: Microseconds for each iteration of the stage's solver.
        per_cell_us: For each occupied cell that it took into account.
        per_call_us: For each decision in which it had something to do.

    Raises:
        EvaluationError: A negative cost.
    """

    name: ClassVar[str] = "host-stage"
    per_iteration_us: int
    per_cell_us: int = 0
    per_call_us: int = 0

    def __post_init__(self) -> None:
        """Check the options."""
        costs = self.per_iteration_us, self.per_cell_us, self.per_call_us
        if min(costs) < 0:
            raise EvaluationError(
                f"latency host-stage: a cost of {min(costs)} us: must be 0 or more"
            )

    def layered(self, latency_us: int, facts: DecisionFacts) -> int:
        """Charge for iterations, cells and the call."""
        called = self.per_call_us if facts.host_iterations else 0
        return (
            latency_us
            + called
            + self.per_iteration_us * facts.host_iterations
            + self.per_cell_us * facts.host_cells
        )

    def to_json(self) -> dict[str, Any]:
        """Return the options, and what is added to."""
        return {
            "per_iteration_us": self.per_iteration_us,
            "per_cell_us": self.per_cell_us,
            "per_call_us": self.per_call_us,
            "of": self.source.to_json(),
        }
