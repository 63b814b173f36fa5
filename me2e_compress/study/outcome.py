"""Results of a study."""

import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from me2e_compress.metrics.measure import Measure
from me2e_compress.runtime.others_load import Load
from me2e_compress.runtime.profile import processor
from me2e_compress.runtime.providers import PROVIDERS
from me2e_compress.study.all_tables import all_tables
from me2e_compress.study.changes import Change, changes, held_against
from me2e_compress.study.condition import Condition
from me2e_compress.study.definition import Study
from me2e_compress.study.drives import Drive
from me2e_compress.study.plan_fidelity import PlanFidelity, measure_json
from me2e_compress.study.prepared import PreparedVariant
from me2e_compress.study.side_by_side import Contrast
from me2e_compress.study.timing import Clock
from me2e_compress.workflows.result import Result, Table, counted

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
        size = prepared.size_bytes
        name = prepared.variant.name
        why = prepared.failure or "no model"
        return cls(
            prepared,
            Measure(None, "MB", why) if size is None else _mb(size),
            {
                percent: Measure(None, "ms", why)
                if prepared.model is None
                else clock.latency(name, percent)
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
            "size": measure_json(self.size_mb),
            "fidelity": self.fidelity.to_json(),
            "latency": {
                f"p{percent}": measure_json(measure)
                for percent, measure in self.latency_ms.items()
            },
        }


@dataclass(frozen=True, repr=False)
class StudyResult(Result):
    """All results of a study, and what they were made with.

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
    drives: tuple[Drive, ...]
    contrasts: tuple[Contrast, ...]
    device_scale: float
    machine: str
    versions: Mapping[str, str]
    load: Load | None = None

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

    @property
    def headline(self) -> str:
        """Title, and numbers of variants, conditions and routes."""
        study, (driven, whole) = self.study, self.coverage
        return (
            f"{study.title}: {counted(len(study.variants), 'variant')} under"
            f" {counted(len(study.conditions), 'condition')} on {driven} of"
            f" {counted(whole, 'route')}"
        )

    def lines(self) -> tuple[str, ...]:
        """Return nothing: the tables say it all."""
        return ()

    def alerts(self) -> tuple[str, ...]:
        """Return the variants that failed, and whether the machine was busy."""
        failed = [each.prepared for each in self.variants if each.prepared.failure]
        busy = [str(self.load)] if self.load is not None and self.load.busy else []
        left_out = (
            f"variant {each.variant.name} was left out: {each.failure}"
            for each in failed
        )
        broken = (
            f"{each.variant}, {each.condition}: {each.scores.failed}"
            for each in self.drives
            if each.scores is not None and each.scores.failed
        )
        return (*left_out, *broken, *busy)

    def tables(self) -> tuple[Table, ...]:
        """Return every table, in reading order."""
        return all_tables(self)

    def records(self) -> list[dict[str, object]]:
        """Return one row per drive."""
        return [self._record(each) for each in self.drives]

    def _record(self, drive: Drive) -> dict[str, object]:
        # a drive that was not made has no scores
        scores, of = drive.scores, self.variant(drive.variant)
        found = (
            {}
            if scores is None
            else {
                "driving_score": scores.driving_score.value,
                "success_rate": scores.success_rate.value,
                "efficiency": scores.efficiency.value,
                "comfort": scores.comfort.value,
            }
        )
        return {
            "variant": drive.variant,
            "condition": drive.condition,
            **found,
            "size_mb": of.size_mb.value,
            **{f"p{p}_ms": each.value for p, each in of.latency_ms.items()},
            "plan_mean_m": of.fidelity.mean_m.value,
        }

    def under(self, condition: Condition) -> tuple[Drive, ...]:
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

    def to_json(self) -> dict[str, Any]:
        """Return a document; the same study and seed give the same bytes but latencies.

        Latencies, and the scale derived from them, are below the keys ``latency``.
        """
        study = self.study
        return {
            "title": study.title,
            "baseline": study.baseline,
            "seed": study.seed,
            "provider": PROVIDERS.text(study.provider),
            "evaluator": study.evaluator,
            "routes": dict(zip(("driven", "set"), self.coverage, strict=True)),
            "conditions": [each.to_json() for each in study.conditions],
            "latency": {
                "device_scale": self.device_scale,
                "samples": study.timing.samples,
                "threads": study.timing.threads,
                **({} if self.load is None else self.load.to_json()),
            },
            "schemes": [each.to_json() for each in self.variants],
            "drives": [each.to_json() for each in self.drives],
            "changes": [each.to_json() for each in self.changes],
            "pairs": [each.to_json() for each in self.pairs],
            "machine": self.machine,
            "versions": dict(self.versions),
        }


def this_machine(load: Load | None = None) -> str:
    """Name processor, cores and system, and a load that makes latencies doubtful."""
    cores = f"{os.cpu_count() or 1} cores"
    named = f"{processor()}, {cores}, {platform.system()} {platform.machine()}"
    return f"{named}; {load}" if load is not None and load.busy else named


def _mb(size_bytes: int) -> Measure:
    return Measure(size_bytes / 1e6, "MB")
