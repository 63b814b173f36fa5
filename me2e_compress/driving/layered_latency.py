"""Latency sources on top of others: a frame limiter, costs that depend on the scene.

A latency spike hurts most in a critical frame (the paper's finding on multi-frame
stability), but a recorded trace has its spikes anywhere. These sources put spikes where
the work is. They draw nothing themselves.
"""

import abc
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Self

import numpy as np

from me2e_compress.driving.latency import (
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
        source: The source below: another latency source, or its text.
    """

    source: LatencySource

    @abc.abstractmethod
    def layered(self, latency_us: int, facts: DecisionFacts) -> int:
        """Return a decision's microseconds, given those of the source below."""

    @property
    def measures(self) -> bool:  # type: ignore[override]
        """Whether the source below measures on this machine."""
        return self.source.measures

    @property
    def measured(self) -> int | None:
        """The number of measurements that the source below draws from."""
        return self.source.measured

    @property
    def lacks_trace(self) -> bool:
        """Whether the source below stands for each model's own latencies."""
        return self.source.lacks_trace

    def with_trace(self, samples_us: tuple[int, ...], scale: float) -> Self:
        """Give the source below the latencies of a model."""
        return replace(self, source=self.source.with_trace(samples_us, scale))

    def to_json(self) -> dict[str, Any]:
        """Return the options, and the source below."""
        named = (each.name for each in fields(self) if each.name != "source")
        own = {name: getattr(self, name) for name in named}
        return {**own, "of": self.source.to_json()}

    def on_route(self, route: str) -> Charge:
        """Start the clock of the source below, and add to it."""
        below = self.source.on_route(route)
        return lambda facts: self.layered(below(facts), facts)


@dataclass(frozen=True)
class LimitedLatency(LayeredLatency):
    """A frame limiter: max(latency, 1 / fps).

    Attributes:
        source: The latency that is limited: another source, or its text.
        fps: The most decisions a second.
    """

    name: ClassVar[str] = "limited"
    fps: float

    def __post_init__(self) -> None:
        check_positive("limited: fps", self.fps)

    def layered(self, latency_us: int, facts: DecisionFacts) -> int:
        """Charge no less than the period."""
        return max(latency_us, round(1e6 / self.fps))

    def to_json(self) -> dict[str, Any]:
        """Return the period in microseconds, and the source below."""
        return {"limit_us": round(1e6 / self.fps), "of": self.source.to_json()}


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
    per_agent_us: int
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


@dataclass(frozen=True)
class HostStageLatency(LayeredLatency):
    """Another source's latency plus that of a policy's host stage.

    Use it with a trace or a rate that covers the network alone. It charges the counted
    work of the stage, not the clock of this machine, so a drive is the same everywhere.

    Attributes:
        source: The network's latency: another source, or its text.
        per_iteration_us: Microseconds for each iteration of the stage's solver.
        per_cell_us: Microseconds for each occupied cell that the stage took into
            account.
        per_call_us: Microseconds for each decision in which the stage had work to do.
    """

    name: ClassVar[str] = "host-stage"
    per_iteration_us: int
    per_cell_us: int = 0
    per_call_us: int = 0

    def __post_init__(self) -> None:
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
