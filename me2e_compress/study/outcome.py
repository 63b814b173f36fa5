"""What a study found, apart from how it is shown."""

import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from me2e_compress.metrics.measure import Measure
from me2e_compress.runtime.latency_trace import Load
from me2e_compress.runtime.profile import processor
from me2e_compress.study.changes import Change, changes, held_against
from me2e_compress.study.condition import Condition
from me2e_compress.study.definition import Study
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.plan_fidelity import PlanFidelity
from me2e_compress.study.prepared import PreparedVariant
from me2e_compress.study.side_by_side import Contrast
from me2e_compress.study.timing import Clock

LATENCY_PERCENTILES = (50, 99)


@dataclass(frozen=True)
class VariantOutcome:
    """A variant's size (1e6 bytes), latency percentiles and plan, without drives."""

    prepared: PreparedVariant
    size_mb: Measure
    latency_ms: Mapping[int, Measure]
    fidelity: PlanFidelity

    @property
    def name(self) -> str:
        """Name of the variant."""
        return self.prepared.variant.name

    @classmethod
    def of(
        cls, prepared: PreparedVariant, clock: Clock, fidelity: PlanFidelity
    ) -> "VariantOutcome":
        """Collect the findings about a variant."""
        name, size = prepared.variant.name, prepared.size_bytes
        why = prepared.failure or "no model"
        unknown = Measure(None, "ms", why)
        return cls(
            prepared,
            Measure(None, "MB", why) if size is None else Measure(size / 1e6, "MB"),
            {
                percent: clock.latency(name, percent) if prepared.model else unknown
                for percent in LATENCY_PERCENTILES
            },
            fidelity,
        )

    def to_json(self) -> dict[str, Any]:
        """Return all facts; everything timed is below the key `latency`."""
        prepared = self.prepared
        return {
            "name": self.name,
            "policy": prepared.variant.policy,
            "pipeline": prepared.pipeline or None,
            "model_sha256": prepared.sha256,
            "weights": prepared.weights,
            "size": self.size_mb.to_json(),
            "fidelity": self.fidelity.to_json(),
            "latency": {
                f"p{percent}": measure.to_json()
                for percent, measure in self.latency_ms.items()
            },
        }


@dataclass(frozen=True, repr=False)
class StudyOutcome:
    """All that a study found, and what it was made with.

    Attributes:
        drives: Condition by condition, the variants in the study's order.
        contrasts: Pictures of moments at which two drives differ.
        device_scale: How many times slower the device is than the machine timed on.
        versions: Versions of the packages that decide the result.
        load: Load by other processes while latencies were measured; None if none was
            measured here.
    """

    study: Study
    variants: tuple[VariantOutcome, ...]
    drives: tuple[DriveRecord, ...]
    contrasts: tuple[Contrast, ...]
    device_scale: float
    machine: str
    versions: Mapping[str, str]
    load: Load | None = None

    @property
    def title(self) -> str:
        """The study's title, with a note if not all routes were driven."""
        return f"{self.study.title}{self.study.preview}"

    @property
    def timed(self) -> bool:
        """Whether the latency of any variant is known."""
        return any(each.latency_ms[50].value is not None for each in self.variants)

    @property
    def coverage(self) -> tuple[int, int]:
        """Number of routes driven, and of routes in the whole set."""
        if self.study.routes:
            return len(self.study.routes), self.study.set_size
        scores = [each.scores for each in self.drives if each.scores is not None]
        return (scores[0].routes, scores[0].expected) if scores else (0, 0)

    def label(self, drive: DriveRecord) -> str:
        """Name a drive by its variant, and by its condition if there are several."""
        if len(self.study.conditions) == 1:
            return drive.variant
        return f"{drive.variant}, {drive.condition}"

    def under(self, condition: Condition) -> tuple[DriveRecord, ...]:
        """Return the drives under one condition."""
        return tuple(each for each in self.drives if each.condition == condition.name)

    @property
    def changes(self) -> tuple[Change, ...]:
        """Cost of each change of a condition, by variant."""
        study = self.study
        return changes(study.conditions, self.drives, study.baseline, study.seed)

    @property
    def pairs(self) -> tuple[Change, ...]:
        """Comparisons of the pairs that the study names."""
        return held_against(self.study.pairs, self.drives, self.study.seed)

    def variant(self, name: str) -> VariantOutcome:
        """Return a variant by its name."""
        return next(each for each in self.variants if each.name == name)


def this_machine(load: Load | None = None) -> str:
    """Name processor, cores and system, and a load that makes latencies doubtful."""
    cores = f"{os.cpu_count() or 1} cores"
    named = f"{processor()}, {cores}, {platform.system()} {platform.machine()}"
    return f"{named}; {load}" if load is not None and load.busy else named
