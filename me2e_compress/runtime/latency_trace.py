"""Latencies of a model as they were measured on one machine."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from me2e_compress import documents
from me2e_compress.display import Displayed, Table, table
from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.atomic import write_json

PERCENTILES = (50, 90, 99)


@dataclass(frozen=True, repr=False)
class LatencyTrace(Displayed):
    """Latencies in the order in which they were measured.

    Attributes:
        model_sha256: Of the model that ran.
        machine: Processor and number of threads, in words.
        samples_us: Microseconds, one an inference, without the warm-up.
        frames: Fingerprint of the recording that the model saw; None: not known.
    """

    model_sha256: str
    machine: str
    samples_us: tuple[int, ...]
    frames: str | None = None

    @property
    def headline(self) -> str:
        """Number of inferences, machine."""
        return f"{len(self.samples_us)} inferences on {self.machine}"

    def tables(self) -> tuple[Table, ...]:
        """Return the percentiles in milliseconds."""
        rows = [
            *((f"p{p}", self.percentile_us(p)) for p in PERCENTILES),
            ("max", self.max_us),
        ]
        shown = [(name, f"{taken_us / 1e3:.2f}") for name, taken_us in rows]
        return (table(self.headline, ("latency", "ms"), shown),)

    def percentile_us(self, percent: float) -> int:
        """Return the smallest sample that so many percent do not exceed."""
        return int(np.percentile(self.samples_us, percent, method="inverted_cdf"))

    @property
    def max_us(self) -> int:
        """The slowest sample."""
        return max(self.samples_us)

    def to_json(self) -> dict[str, Any]:
        """Return p50, p90, p99 and max beside the samples."""
        frames = {} if self.frames is None else {"frames": self.frames}
        return {
            "model_sha256": self.model_sha256,
            "machine": self.machine,
            **frames,
            **{f"p{p}_us": self.percentile_us(p) for p in PERCENTILES},
            "max_us": self.max_us,
            "samples_us": list(self.samples_us),
        }

    def save(self, path: Path) -> None:
        """Write the trace atomically.

        Raises:
            EvaluationError: The file cannot be written.
        """
        try:
            write_json(path, self.to_json())
        except OSError as error:
            raise EvaluationError(
                f"{path}: cannot be written: {error.strerror}"
            ) from error

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a trace; its percentiles are not trusted but computed again.

        Raises:
            EvaluationError: No such file, or not a trace with at least one sample.
        """
        try:
            record = _Record.model_validate_json(documents.content(path))
        except OSError as error:
            raise EvaluationError(f"{path}: {error.strerror}") from error
        except documents.MalformedError as error:
            raise EvaluationError(f"{path}: not a latency trace: {error}") from error
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            where = ".".join(map(str, first["loc"])) or "the file"
            raise EvaluationError(
                f"{path}: not a latency trace: {where}: {first['msg']}"
            ) from error
        samples_us = tuple(record.samples_us)
        return cls(record.model_sha256, record.machine, samples_us, record.frames)


class _Record(BaseModel):
    model_config = ConfigDict(strict=True)

    model_sha256: str
    machine: str
    frames: str | None = None
    samples_us: Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)]
