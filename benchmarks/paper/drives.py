"""The paper's drives so far, and facts of the files that drove."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from pydantic import ConfigDict, TypeAdapter, with_config

from benchmarks.paper.accident import Accident
from benchmarks.paper.questions import SHIPPED, PaperQuestions
from me2e_compress.base import atomic, documents
from me2e_compress.base.atomic import write_json
from me2e_compress.base.errors import StudyError
from me2e_compress.metrics.route_summary import COLUMNS, RouteColumn
from me2e_compress.runtime.energy import EnergyResult
from me2e_compress.study import Study
from me2e_compress.study.drive_record import DriveRecord

FILE = "variants.json"
SCHEMES = ("exact", "prediction", "feature-ext", "full")
"""Rows of table 4."""

_STRICT = ConfigDict(allow_inf_nan=False, extra="forbid")


@with_config(_STRICT)
@dataclass(frozen=True)
class Int8Counts:
    """Counts of the int8 part of a graph.

    ``tensors`` are activations with a scale of their own (nodes that quantize),
    ``operators`` are nodes that read int8: layers, attention products, residual Adds.
    Those that are convolutions or matrix products are ``compute_intensive``.
    """

    tensors: int
    operators: int
    compute_intensive: int


@with_config(_STRICT)
@dataclass(frozen=True)
class ModelFacts:
    """A variant's file.

    Attributes:
        pipeline: The passes that made it, as text.
        size_bytes: Size of the file with its weights.
        macs: Multiply-accumulates of one inference.
        int8: None for a file without a plan.
        latency_us: Latencies of inferences alone, warm, on the target device.
        runs_us: Medians of separated runs, each with sessions opened anew, in turn with
            those of the other variants.
        modules_us: Latencies by module under a profiler, on the target device.
        modelled_j: Joules per frame from published energies of MACs and bytes.
        joules: Measured joules per frame, and the ends of their 95 % interval; None
            without a counter, and ``no_joules`` says why.
        failure: Why there is no file that can drive; empty if there is one.
    """

    variant: str
    sha256: str | None = None
    pipeline: str = ""
    size_bytes: int | None = None
    parameters: int | None = None
    macs: int | None = None
    int8: Int8Counts | None = None
    latency_us: tuple[int, ...] = ()
    modules_us: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    modelled_j: float | None = None
    joules: tuple[float, float, float] | None = None
    no_joules: str = "not measured"
    failure: str = ""
    runs_us: tuple[int, ...] = ()

    def latency_ms(self, percent: float) -> float | None:
        """Return a percentile of the latencies; None if none were measured."""
        if not self.latency_us:
            return None
        return float(np.percentile(self.latency_us, percent, method="higher")) / 1e3

    @property
    def fps(self) -> float | None:
        """Inferences per second at the mean latency, as in the paper's FPS column."""
        if not self.latency_us:
            return None
        return 1e6 / float(np.mean(self.latency_us))

    @property
    def of_another_stack(self) -> bool:
        """Whether it serves table 4 only: a variant's name has no space."""
        return " " in self.variant

    def with_energy(self, found: EnergyResult) -> "ModelFacts":
        """Return it with a counter's measurement, or why there is none."""
        if found.j_per_frame is None:
            return replace(self, no_joules=found.reason)
        low, high = found.low or 0.0, found.high or found.j_per_frame
        return replace(self, joules=(found.j_per_frame, low, high), no_joules="")


@with_config(_STRICT)
@dataclass(frozen=True)
class KeptFacts:
    """Facts of files, as they are kept, and what they were measured on."""

    device_scale: float
    variants: tuple[ModelFacts, ...]
    machine: str = ""

    def save(self, path: Path) -> None:
        """Write them as JSON."""
        with atomic.writing_errors(path, StudyError):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, _KEPT.dump_python(self, mode="json"))

    @classmethod
    def load(cls, path: Path) -> "KeptFacts":
        """Read a file that `save` wrote."""
        with documents.reading(path, StudyError, "not facts of variants"):
            content = documents.from_json(documents.read_bytes(path))
            return _KEPT.validate_python(content)

    @property
    def by_variant(self) -> dict[str, ModelFacts]:
        """Facts by the name of the variant."""
        return {each.variant: each for each in self.variants}


_KEPT = TypeAdapter(KeptFacts)


@dataclass(frozen=True)
class PaperDrives:
    """The drives of the paper's study so far, and facts about the files that drove.

    Attributes:
        device_scale: How many times slower the device is than the machine timed on.
        questions: File of the questions that are asked now.
        asked: The questions as they were before the first drive, if that is known.
        asked_of: Digest of the questions that a drive was made for, by its name; none
            of a drive whose record does not know it.
    """

    study: Study
    drives: tuple[DriveRecord, ...]
    device_scale: float
    machine: str
    facts: tuple[ModelFacts, ...] = ()
    accident: Accident | None = None
    questions: Path = SHIPPED
    asked: PaperQuestions | None = None
    asked_of: Mapping[str, str] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """The study's title, with a note if not all routes were driven."""
        return f"{self.study.title}{self.study.preview}"

    @property
    def finished(self) -> tuple[DriveRecord, ...]:
        """The drives that did not fail."""
        return tuple(each for each in self.drives if not each.reason)

    @cached_property
    def columns(self) -> tuple[RouteColumn, ...]:
        """The scores that a route of any drive has: early records lack some."""
        routes = [each for drive in self.finished for each in drive.routes]
        found = (e for e in COLUMNS if any(e.of(each) is not None for each in routes))
        return tuple(found) if routes else COLUMNS

    @property
    def distinct(self) -> int:
        """Number of drives that differ in more than what was charged."""
        found = {
            tuple(replace(e, latency_us=(), latency_sum_us=0) for e in each.routes)
            for each in self.finished
        }
        return len(found)

    def fact(self, variant: str) -> ModelFacts:
        """Return the facts about a variant; empty facts if it was not prepared."""
        found = (each for each in self.facts if each.variant == variant)
        return next(found, ModelFacts(variant))

    def drive(self, variant: str, condition: str) -> DriveRecord:
        """Return a drive; one that was not made says why."""
        for each in self.drives:
            if (each.variant, each.condition) == (variant, condition):
                return each
        why = self.fact(variant).failure or f"{variant} under {condition}: not driven"
        return DriveRecord(variant, condition, reason=why)
