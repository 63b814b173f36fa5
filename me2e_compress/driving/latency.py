"""Latency sources: how long a decision takes on the vehicle.

To add one: write its class, then add it to the table of names.
"""

import abc
import functools
import hashlib
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from itertools import cycle
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt
from pydantic import GetCoreSchemaHandler
from pydantic_core import CoreSchema

from me2e_compress.base.errors import EvaluationError
from me2e_compress.base.registry import Registry
from me2e_compress.driving.contract import Count, Positive
from me2e_compress.runtime.latency_trace import LatencyTrace

__all__ = [
    "LATENCY_SOURCES",
    "Charge",
    "DecisionFacts",
    "FixedLatency",
    "FrameRate",
    "LatencySource",
    "MeasuredLatency",
    "NoLatency",
    "TraceLatency",
    "parse_latency",
]


@dataclass(frozen=True, eq=False, slots=True)
class DecisionFacts:
    """What a decision took here and what it saw, as the simulator tells it.

    Attributes:
        measured_us: Microseconds that it took on this machine.
        agents_m: float64 [N, 2], positions of other road users, occluded or not, metres
            in the ego frame, x forward, y left; None if the simulator does not tell.
        host_iterations: Solver iterations of a policy's host stage; 0 without one, or
            if it had nothing to do.
        host_cells: Occupied cells that the host stage took into account.
    """

    measured_us: int
    agents_m: npt.NDArray[np.float64] | None = None
    host_iterations: int = 0
    host_cells: int = 0


Charge = Callable[[DecisionFacts], int]  # to microseconds on the vehicle


@dataclass(frozen=True)
class LatencySource(abc.ABC):
    """Says what each decision of a route costs; its fields are its options.

    An option of this type takes another source, or its text. ``measures`` is True if
    the source measures on this machine: such routes must run alone.
    """

    name: ClassVar[str]
    measures: ClassVar[bool] = False

    @abc.abstractmethod
    def on_route(self, route: str) -> Charge:
        """Return the clock of a route; it depends only on the route's name."""

    @abc.abstractmethod
    def to_json(self) -> dict[str, Any]:
        """Return what decides the latencies, for the fingerprint of the results."""

    @property
    def measured(self) -> int | None:
        """The number of measurements that it draws from; None if it draws none."""
        return None

    @property
    def lacks_trace(self) -> bool:
        """Whether it stands for latencies that `with_trace` has yet to give."""
        return False

    def with_trace(self, samples_us: tuple[int, ...], scale: float) -> "LatencySource":
        """Return it with these samples (microseconds, in order) if it lacks them.

        ``scale`` multiplies them in addition to the source's own.
        """
        return self

    def __str__(self) -> str:
        """Return the text that `LATENCY_SOURCES` reads."""
        return LATENCY_SOURCES.text(self)

    @classmethod
    def __get_pydantic_core_schema__(
        cls, source: type, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Let an option that is any source take its text."""
        if cls is not LatencySource:
            return handler(source)
        return LATENCY_SOURCES.option_schema(LatencySource)


_HERE = "me2e_compress.driving.latency"

LATENCY_SOURCES: Registry[LatencySource] = Registry(
    "latency source",
    "me2e_compress.latency_sources",
    EvaluationError,
    {
        "none": f"{_HERE}:NoLatency",
        "fps": f"{_HERE}:FrameRate",
        "fixed": f"{_HERE}:FixedLatency",
        "trace": f"{_HERE}:TraceLatency",
        "measured": f"{_HERE}:MeasuredLatency",
        "limited": f"{_HERE}:LimitedLatency",
        "host-stage": f"{_HERE}:HostStageLatency",
    },
)


@dataclass(frozen=True)
class FixedLatency(LatencySource):
    """The same time for every decision.

    Attributes:
        latency_us: Microseconds, not negative.
    """

    name: ClassVar[str] = "fixed"
    latency_us: Count = 0

    def on_route(self, route: str) -> Charge:
        """Charge the same on every route."""
        return lambda _: self.latency_us

    def to_json(self) -> dict[str, Any]:
        """Return the microseconds."""
        return {"fixed_us": self.latency_us}


@dataclass(frozen=True)
class NoLatency(FixedLatency):
    """No time at all: the ideal."""

    name: ClassVar[str] = "none"
    latency_us: int = field(default=0, init=False)


@dataclass(frozen=True)
class FrameRate(FixedLatency):
    """The period of a frame rate for every decision: at 10 fps, 100 ms.

    Attributes:
        fps: Decisions a second.
    """

    name: ClassVar[str] = "fps"
    latency_us: int = field(default=0, init=False)
    fps: Positive

    def __post_init__(self) -> None:
        object.__setattr__(self, "latency_us", round(1e6 / self.fps))


@dataclass(frozen=True)
class TraceLatency(LatencySource):
    """Latencies recorded before, often on another device.

    Attributes:
        trace: File that `profile` wrote; or the samples themselves, microseconds in the
            order of the recording. Without it, in a study, each model's own.
        in_order: Replay them in order from the first on every route, which keeps the
            bursts, and start over at the end; else draw them with replacement.
        scale: Speed ratio between the recording device and the one imagined.
        seed: Seed of the draws; each route has its own stream, so the order of routes
            does not matter.
    """

    name: ClassVar[str] = "trace"
    trace: Path | tuple[int, ...] | None = None
    in_order: bool = False
    scale: Positive = 1.0
    seed: Count = 0

    def __post_init__(self) -> None:
        """Read the trace before anything drives."""
        if not self.lacks_trace and not self.samples_us:
            raise EvaluationError("latency trace: there are no samples")

    @functools.cached_property
    def samples_us(self) -> tuple[int, ...]:
        """Microseconds, read once: the source is sent to other processes with them."""
        if isinstance(self.trace, Path):
            return LatencyTrace.load(self.trace).samples_us
        if self.trace is None:
            raise EvaluationError("latency trace: it names no file (trace:FILE)")
        return self.trace

    @property
    def measured(self) -> int | None:
        """The number of samples in the trace, however often one is drawn."""
        return None if self.lacks_trace else len(self.samples_us)

    @property
    def lacks_trace(self) -> bool:
        """Whether it stands for each model's own latencies."""
        return self.trace is None

    def with_trace(self, samples_us: tuple[int, ...], scale: float) -> LatencySource:
        """Return it with a model's own latencies, if it stands for them."""
        if not self.lacks_trace:
            return self
        return replace(self, trace=samples_us, scale=scale * self.scale)

    def on_route(self, route: str) -> Charge:
        """Charge the next sample of the trace."""
        # The same stream on a route whatever drove before
        scaled = [round(sample * self.scale) for sample in self.samples_us]
        if self.in_order:
            replay = cycle(scaled)
            return lambda _: next(replay)
        stream = np.random.default_rng([self.seed, zlib.crc32(route.encode())])
        return lambda _: scaled[int(stream.integers(len(scaled)))]

    def to_json(self) -> dict[str, Any]:
        """Return the options and a digest of the samples."""
        text = ",".join(map(str, self.samples_us))
        return {
            "trace_sha256": hashlib.sha256(text.encode()).hexdigest(),
            "in_order": self.in_order,
            "scale": self.scale,
            "seed": self.seed,
        }


@dataclass(frozen=True)
class MeasuredLatency(LatencySource):
    """What the decision takes on this machine, now. Not reproducible.

    Attributes:
        scale: Speed ratio between this machine and the one imagined.
    """

    name: ClassVar[str] = "measured"
    measures: ClassVar[bool] = True
    scale: Positive = 1.0

    def on_route(self, route: str) -> Charge:
        """Charge the measured time."""
        return lambda facts: round(facts.measured_us * self.scale)

    def to_json(self) -> dict[str, Any]:
        """Return the scale."""
        return {"measured": True, "scale": self.scale}


def parse_latency(text: str, *, seed: int = 0) -> LatencySource:
    """Build the latency source of a text, e.g. ``fps:10`` or ``trace:FILE``.

    A ``seed`` is that of a text without one; in a layered source it applies to the
    source below.

    Raises:
        EvaluationError: No such source, or an option that it refuses or has not.
    """
    return with_draws(LATENCY_SOURCES.parse(text), seed)


def with_draws(source: LatencySource, seed: int) -> LatencySource:
    """Give the innermost source the seed of its draws, if it draws and names none."""
    # Go down to the source that draws
    below = getattr(source, "source", None)
    if isinstance(below, LatencySource):
        drawn = with_draws(below, seed)
        return LATENCY_SOURCES.with_options(source, {"source": drawn})
    if seed and getattr(source, "seed", None) == 0:
        return LATENCY_SOURCES.with_options(source, {"seed": seed})
    return source


# Sources on top of others: a frame limiter, costs that depend on the work. A latency
# spike hurts most in a critical frame (the paper's finding on multi-frame stability),
# but a recorded trace has its spikes anywhere. These put spikes where the work is; they
# draw nothing themselves.
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
        # Options in the order of their fields: fingerprints depend on it
        named = (field.name for field in fields(self) if field.name != "source")
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
    fps: Positive

    def layered(self, latency_us: int, facts: DecisionFacts) -> int:
        """Charge no less than the period."""
        return max(latency_us, round(1e6 / self.fps))

    def to_json(self) -> dict[str, Any]:
        """Return the period in microseconds, and the source below."""
        return {"limit_us": round(1e6 / self.fps), "of": self.source.to_json()}


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
    per_iteration_us: Count
    per_cell_us: Count = 0
    per_call_us: Count = 0

    def layered(self, latency_us: int, facts: DecisionFacts) -> int:
        """Charge for iterations, cells and the call."""
        calls = int(facts.host_iterations > 0)
        work_us = self.per_iteration_us * facts.host_iterations
        work_us += self.per_cell_us * facts.host_cells + self.per_call_us * calls
        return latency_us + work_us
