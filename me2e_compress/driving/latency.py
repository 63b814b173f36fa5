"""How long a decision takes on the vehicle, and who says so."""

import hashlib
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import cycle
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.latency_trace import LatencyTrace

Charge = Callable[[int], int]
"""From the microseconds a decision took here to those it takes on the vehicle."""


class LatencySource(Protocol):
    """Says what each decision of a route costs."""

    @property
    def measures(self) -> bool:
        """Whether it depends on this machine, now: such routes must run alone."""
        ...

    def on_route(self, route: str) -> Charge:
        """Return the clock of one route; it depends on nothing but its identity."""
        ...

    def to_json(self) -> dict[str, Any]:
        """Return what decides the latencies, for the fingerprint of the results."""
        ...


@dataclass(frozen=True)
class FixedLatency:
    """Every decision takes the same time: a frame rate, or zero for the ideal."""

    latency_us: int = 0
    measures: bool = field(default=False, init=False)

    def on_route(self, route: str) -> Charge:
        """Charge the same for every decision of every route."""
        return lambda _: self.latency_us

    def to_json(self) -> dict[str, Any]:
        """Return the microseconds."""
        return {"fixed_us": self.latency_us}


@dataclass(frozen=True)
class TraceLatency:
    """Latencies recorded before, often on another device.

    Args:
        samples_us: Microseconds, in the order of the recording.
        in_order: Replay them in order from the first on every route, which keeps the
            bursts, and start over at the end; else draw them with replacement.
        scale: Speed ratio between the recording device and the one imagined.
        seed: Of the draws; each route has its own stream, whatever drives before it.

    Raises:
        EvaluationError: A negative seed.
    """

    samples_us: tuple[int, ...]
    in_order: bool = False
    scale: float = 1.0
    seed: int = 0
    measures: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        """Refuse a seed that nothing can be drawn with, before anything drives."""
        if self.seed < 0:
            raise EvaluationError(f"latency: seed {self.seed}: must be 0 or more")

    def on_route(self, route: str) -> Charge:
        """Charge what the trace says next."""
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
class MeasuredLatency:
    """What the decision takes on this machine, now. Not reproducible."""

    scale: float = 1.0
    measures: bool = field(default=True, init=False)

    def on_route(self, route: str) -> Charge:
        """Charge what was measured."""
        return lambda measured_us: round(measured_us * self.scale)

    def to_json(self) -> dict[str, Any]:
        """Return the scale."""
        return {"measured": True, "scale": self.scale}


def parse_latency(
    text: str, *, in_order: bool = False, scale: float = 1.0, seed: int = 0
) -> LatencySource:
    """Read ``none``, ``fps:F``, ``trace:FILE`` or ``measured``.

    Args:
        text: Which source; ``fps:10`` charges 100 ms a decision.
        in_order: For a trace, see `TraceLatency`.
        scale: For a trace or a measurement.
        seed: For a trace.

    Raises:
        EvaluationError: Another word, a frame rate or a scale that is not positive, a
            negative seed, or a file that is no trace.
    """
    if not 0.0 < scale < float("inf"):
        raise EvaluationError(f"latency scale {scale}: must be a positive number")
    kind, _, value = text.partition(":")
    if text == "none":
        return FixedLatency()
    if text == "measured":
        return MeasuredLatency(scale)
    if kind == "fps" and value:
        return FixedLatency(_period_us(value))
    if kind == "trace" and value:
        samples = LatencyTrace.load(Path(value)).samples_us
        return TraceLatency(samples, in_order, scale, seed)
    raise EvaluationError(
        f"latency {text!r}: there are none, fps:F, trace:FILE and measured"
    )


def _period_us(text: str) -> int:
    try:
        fps = float(text)
    except ValueError:
        fps = float("nan")
    if not 0.0 < fps < float("inf"):
        raise EvaluationError(f"latency fps:{text}: {text} is not a positive number")
    return round(1e6 / fps)
