"""Latencies of a model measured on one machine."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Self, TypeAlias

from pydantic import BaseModel, ConfigDict, Field

from me2e_compress.display import Table, counted, not_measured, table
from me2e_compress.errors import EvaluationError
from me2e_compress.metrics.measure import percentile, too_few
from me2e_compress.registry import documents, drafts
from me2e_compress.runtime.atomic import write_document
from me2e_compress.runtime.others_load import Load

PERCENTILES = (50, 90, 99)

Microseconds: TypeAlias = Mapping[str, tuple[int, ...]]
"""Microseconds by name, one for each inference."""


@dataclass(frozen=True)
class TimeShare:
    """The share of one part in a model's time; percentiles need enough samples."""

    name: str
    share: float
    p50_us: int | None
    p90_us: int | None
    p99_us: int | None
    max_us: int


def shares(parts: Microseconds) -> tuple[TimeShare, ...]:
    """Return the share of each part over all inferences."""
    whole = max(1, sum(map(sum, parts.values())))
    return tuple(
        TimeShare(
            name,
            sum(samples) / whole,
            _known_percentile(samples, 50),
            _known_percentile(samples, 90),
            _known_percentile(samples, 99),
            max(samples),
        )
        for name, samples in parts.items()
    )


def shares_table(title: str, what: str, parts: Microseconds) -> Table:
    """Return a table of the parts: share, then percentiles in milliseconds."""
    rows = [
        (
            each.name,
            f"{each.share:.1%}",
            *map(_ms, (each.p50_us, each.p90_us, each.p99_us, each.max_us)),
        )
        for each in shares(parts)
    ]
    columns = (what, "share", "p50 ms", "p90 ms", "p99 ms", "max ms")
    count = min(map(len, parts.values()), default=0)
    return table(title, columns, rows, _missing_percentiles(count))


def _known_percentile(samples: Sequence[int], percent: float) -> int | None:
    """Return a percentile; None where there are too few samples for it."""
    return None if too_few(percent, len(samples)) else percentile(samples, percent)


def _missing_percentiles(count: int) -> str:
    """Say which percentiles need more samples."""
    why = {f"p{percent}": too_few(percent, count) for percent in PERCENTILES}
    return not_measured({name: each for name, each in why.items() if each})


def _ms(taken_us: int | None) -> str:
    return "-" if taken_us is None else f"{taken_us / 1e3:.2f}"


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
    samples_us: tuple[int, ...]
    frames: str | None = None
    modules_us: Microseconds = field(default_factory=dict)
    others: Load | None = None

    @property
    def headline(self) -> str:
        """The number of inferences and the machine."""
        return f"{counted(len(self.samples_us), 'inference')} on {self.machine}"

    def tables(self) -> tuple[Table, ...]:
        """Return the percentiles in milliseconds, and the times of modules."""
        rows = [
            *((f"p{p}", _known_percentile(self.samples_us, p)) for p in PERCENTILES),
            ("max", self.max_us),
        ]
        shown = [(name, _ms(taken_us)) for name, taken_us in rows]
        note = _missing_percentiles(len(self.samples_us))
        whole = table(self.headline, ("latency", "ms"), shown, note)
        # Times of modules are optional.
        if not self.modules_us:
            return (whole,)
        count = len(next(iter(self.modules_us.values())))
        title = f"By module, {count} inferences under a profiler"
        return whole, shares_table(title, "module", self.modules_us)

    def percentile_us(self, percent: float) -> int:
        """Return the smallest sample that ``percent`` of the samples do not exceed."""
        return percentile(self.samples_us, percent)

    @property
    def max_us(self) -> int:
        """The slowest sample."""
        return max(self.samples_us)

    def to_json(self) -> dict[str, Any]:
        """Return p50, p90, p99 and max with the samples; None with too few samples."""
        frames = {} if self.frames is None else {"frames": self.frames}
        taken = {name: list(each) for name, each in self.modules_us.items()}
        modules = {"modules_us": taken} if taken else {}
        others = self.others
        busy = {} if others is None else others.to_json()
        # What was not measured is left out.
        return {
            "model_sha256": self.model_sha256,
            "machine": self.machine,
            **frames,
            **busy,
            **{f"p{p}_us": _known_percentile(self.samples_us, p) for p in PERCENTILES},
            "max_us": self.max_us,
            "samples_us": list(self.samples_us),
            **modules,
        }

    def save(self, path: Path) -> None:
        """Write the trace atomically."""
        with drafts.written(path, EvaluationError):
            write_document(path, self.to_json())

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a trace; its percentiles are recomputed from the samples."""
        with documents.reading(path, EvaluationError, "not a latency trace"):
            record = _Record.model_validate_json(documents.content(path))
        return cls(
            record.model_sha256,
            record.machine,
            tuple(record.samples_us),
            record.frames,
            {name: tuple(taken) for name, taken in record.modules_us.items()},
            record.others,
        )


_Samples: TypeAlias = Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)]


class _Record(BaseModel):
    model_config = ConfigDict(strict=True)

    model_sha256: str
    machine: str
    frames: str | None = None
    samples_us: _Samples
    modules_us: dict[str, _Samples] = Field(default_factory=dict)
    others_cores: Annotated[float, Field(ge=0)] | None = None
    cores: Annotated[int, Field(ge=1)] | None = None

    @property
    def others(self) -> Load | None:
        if self.others_cores is None or self.cores is None:
            return None
        return Load(self.others_cores, self.cores)
