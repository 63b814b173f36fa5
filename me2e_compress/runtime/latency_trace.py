"""Latencies of a model measured on one machine."""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Self, TypeAlias, TypeVar

import psutil
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    TypeAdapter,
    model_validator,
    with_config,
)

from me2e_compress.base import atomic, documents
from me2e_compress.base.atomic import write_document
from me2e_compress.base.display import Table, missing_note, plural, table
from me2e_compress.base.errors import EvaluationError
from me2e_compress.metrics.measure import percentile, too_few

# Share of the cores that other processes may take before a latency is in doubt: they
# move our threads between cores and evict caches long before all cores are taken.
BUSY_SHARE = 0.1
# Shortest block to be judged, seconds: systems count CPU time in ticks of 10 ms.
SHORTEST_S = 0.5


@with_config(ConfigDict(strict=True))
@dataclass(frozen=True)
class Load:
    """Mean number of cores that other processes took during a measurement."""

    others: Annotated[float, Field(ge=0, alias="others_cores")]
    cores: Annotated[int, Field(ge=1)]

    @property
    def busy(self) -> bool:
        """Whether they took more than `BUSY_SHARE` of the cores."""
        return self.others > BUSY_SHARE * self.cores

    def to_json(self) -> dict[str, float]:
        """Return ``others_cores`` and ``cores``."""
        return {"others_cores": self.others, "cores": self.cores}

    def __str__(self) -> str:
        load = f"other processes took {self.others:.1f} of {self.cores} cores"
        if not self.busy:
            return load
        return (
            f"the machine was busy: {load}, and more than {BUSY_SHARE:.0%}"
            " moves latencies; measure again when it is idle"
        )


class OthersLoad:
    """Measure the cores that other processes keep busy while a block runs.

    ``machine`` and ``ours`` return CPU seconds of all processes, and of this process
    with its ended children. ``load`` is None before the end, or if the block was too
    short.
    """

    def __init__(
        self,
        machine: Callable[[], float] | None = None,
        ours: Callable[[], float] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._machine, self._ours = machine or _all_cpu_seconds, ours or cpu_seconds
        self._clock = clock
        self.load: Load | None = None

    def __enter__(self) -> Self:
        self._begun = self._clock(), self._machine(), self._ours()
        return self

    def __exit__(self, *_: object) -> None:
        wall, machine, ours = (
            now - then
            for now, then in zip(
                (self._clock(), self._machine(), self._ours()), self._begun, strict=True
            )
        )
        # A short block is not judged.
        if wall >= SHORTEST_S:
            others = max(0.0, machine - ours) / wall
            self.load = Load(others, os.cpu_count() or 1)


def _all_cpu_seconds() -> float:
    """Return the CPU time of all processes since boot, without idle and waiting."""
    times = psutil.cpu_times()
    idle = times.idle + getattr(times, "iowait", 0.0)
    guests = getattr(times, "guest", 0.0) + getattr(times, "guest_nice", 0.0)
    return float(sum(times) - idle - guests)  # guests are in user and nice already


def cpu_seconds() -> float:
    """Return the CPU time of this process and of its children that have ended."""
    times = os.times()
    return sum((times.user, times.system, times.children_user, times.children_system))


PERCENTILES = (50, 90, 99)

# Microseconds by name, one for each inference
Microseconds: TypeAlias = Mapping[str, tuple[int, ...]]


@dataclass(frozen=True)
class TimeShare:
    """The share of one part in a model's time; percentiles need enough samples."""

    name: str
    share: float
    p50_us: int | None
    p90_us: int | None
    p99_us: int | None
    max_us: int


def time_shares(parts: Microseconds) -> tuple[TimeShare, ...]:
    """Return the share of each part in the time of all inferences, in their order."""
    whole = max(1, sum(map(sum, parts.values())))
    return tuple(
        TimeShare(name, sum(samples) / whole, *_percentiles(samples))
        for name, samples in parts.items()
    )


def _percentiles(
    samples: Sequence[int],
) -> tuple[int | None, int | None, int | None, int]:
    """Return p50, p90, p99, None with too few samples, and the largest."""
    p50, p90, p99 = (
        None if too_few(percent, len(samples)) else percentile(samples, percent)
        for percent in PERCENTILES
    )
    return p50, p90, p99, max(samples)


def _percentile_texts(samples: Sequence[int]) -> list[str]:
    """Write p50, p90, p99 and the largest in milliseconds, a dash for too few."""
    return ["-" if us is None else f"{us / 1e3:.2f}" for us in _percentiles(samples)]


def shares_table(title: str, kind: str, parts: Microseconds) -> Table:
    """Return a row for each part of a kind: share, then percentiles, milliseconds."""
    rows = [
        (part.name, f"{part.share:.1%}", *_percentile_texts(parts[part.name]))
        for part in time_shares(parts)
    ]
    columns = (kind, "share", "p50 ms", "p90 ms", "p99 ms", "max ms")
    count = min(map(len, parts.values()), default=0)
    return table(title, columns, rows, _percentiles_note(count))


def _percentiles_note(count: int) -> str:
    """Return the note of a table on percentiles that need more samples, or ""."""
    why = {f"p{percent}": too_few(percent, count) for percent in PERCENTILES}
    return missing_note({name: reason for name, reason in why.items() if reason})


# Microseconds of one inference or more; a list in a file
Samples: TypeAlias = Annotated[
    tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1, strict=False)
]


@with_config(ConfigDict(strict=True))
@dataclass(frozen=True, repr=False)
class LatencyTrace:
    """Latencies in the order in which they were measured.

    Attributes:
        model_sha256: digest of the model that ran.
        machine: description of the processor and the number of threads.
        samples_us: microseconds of each inference, without the warm-up.
        frames: fingerprint of the recording; None if unknown.
        modules_us: time of each module in as many separate inferences under a profiler;
            empty if not measured.
        others: load by other processes meanwhile; None if not measured.
    """

    model_sha256: str
    machine: str
    samples_us: Samples
    frames: str | None = None
    modules_us: Mapping[str, Samples] = field(default_factory=dict)
    others: Load | None = None

    @property
    def headline(self) -> str:
        """The number of inferences and the machine."""
        return f"{plural(len(self.samples_us), 'inference')} on {self.machine}"

    def tables(self) -> tuple[Table, ...]:
        """Return the percentiles in milliseconds, and the times of modules."""
        names = (*(f"p{percent}" for percent in PERCENTILES), "max")
        rows = list(zip(names, _percentile_texts(self.samples_us), strict=True))
        note = _percentiles_note(len(self.samples_us))
        whole = table(self.headline, ("latency", "ms"), rows, note)
        # Times of modules are optional.
        if not self.modules_us:
            return (whole,)
        count = len(next(iter(self.modules_us.values())))
        title = f"By module, {count} inferences under a profiler"
        return whole, shares_table(title, "module", self.modules_us)

    def percentile_us(self, percent: float) -> int:
        """Return the smallest sample that ``percent`` of the samples do not exceed."""
        return percentile(self.samples_us, percent)

    def to_json(self) -> dict[str, Any]:
        """Return p50, p90, p99 and max with the samples; None with too few samples."""
        modules = {name: list(samples) for name, samples in self.modules_us.items()}
        names = (*(f"p{percent}_us" for percent in PERCENTILES), "max_us")
        # What was not measured is left out.
        return {
            "model_sha256": self.model_sha256,
            "machine": self.machine,
            **({} if self.frames is None else {"frames": self.frames}),
            **({} if self.others is None else self.others.to_json()),
            **dict(zip(names, _percentiles(self.samples_us), strict=True)),
            "samples_us": list(self.samples_us),
            **({"modules_us": modules} if modules else {}),
        }

    def save(self, path: Path) -> None:
        """Write the trace atomically; an EvaluationError if it cannot be written."""
        with atomic.writing_errors(path, EvaluationError):
            write_document(path, self.to_json())

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a trace, without its percentiles; an EvaluationError if it is none."""
        with documents.reading(path, EvaluationError, "not a latency trace"):
            return TypeAdapter(cls).validate_json(documents.read_bytes(path))

    @model_validator(mode="before")
    @classmethod
    def _with_load(cls, record: Any) -> Any:
        """Read the load from its two numbers, which a file has among the others."""
        if not isinstance(record, dict):
            return record
        known = None not in (record.get("others_cores"), record.get("cores"))
        return {**record, "others": record if known else None}


# Latencies that other tools wrote; the content tells the format.


FORMATS = "times or a profile of trtexec, or a latency trace, is expected"
_LONGEST_MS = 1e9


@dataclass(frozen=True)
class ImportedLatency:
    """What was read from a file of another tool.

    ``samples_us`` has one latency for each inference, ``layers_us`` the average of each
    layer, which may be empty; ``machine`` is what measured.
    """

    samples_us: tuple[int, ...]
    machine: str
    layers_us: Mapping[str, tuple[int, ...]] = field(default_factory=dict)


def read_latencies(path: Path) -> ImportedLatency:
    """Read one file; an EvaluationError if it is missing, or of no such form."""
    with documents.reading(path, EvaluationError, FORMATS):
        document = documents.from_json(documents.read_bytes(path))
        if isinstance(document, dict):
            trace = LatencyTrace.load(path)
            return ImportedLatency(trace.samples_us, trace.machine or "a trace")
        # A list is trtexec's. `--exportTimes`: inferences with `latencyMs` (copying in,
        # computing, copying out; TensorRT's samples/common/sampleReporting.cpp).
        # `--exportProfile`: `count`, then layers with `averageMs`; there are no single
        # inferences, so the sum of the averages is one sample
        first = next((entry for entry in document if isinstance(entry, dict)), {})
        if "count" not in first:
            times = TypeAdapter(_NonEmpty[_Time]).validate_python(document)
            samples = tuple(round(1e3 * time_ms.latencyMs) for time_ms in times)
            return ImportedLatency(samples, "times of trtexec")
        # Sum layers of the same name: trtexec repeats the names in loops.
        layers = dict[str, int]()
        for layer in TypeAdapter(_NonEmpty[_Layer]).validate_python(document[1:]):
            total_us = layers.get(layer.name, 0) + round(1e3 * layer.averageMs)
            layers[layer.name] = total_us
        by_cost = sorted(layers.items(), key=lambda item: -item[1])
        layers_us = {name: (total_us,) for name, total_us in by_cost}
        total = (sum(layers.values()),)
        return ImportedLatency(total, "a profile of trtexec", layers_us)


_Ms = Annotated[float, Field(ge=0.0, le=_LONGEST_MS, allow_inf_nan=False)]


class _Time(BaseModel):
    latencyMs: _Ms  # noqa: N815 - trtexec's name


class _Layer(BaseModel):
    name: str
    averageMs: _Ms  # noqa: N815 - trtexec's name


_T = TypeVar("_T")
_NonEmpty = Annotated[list[_T], Field(min_length=1)]
