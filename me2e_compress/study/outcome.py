"""What a study knows of a variant without its drives: size, latency, plan."""

import math
import os
import platform
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.errors import EvaluationError, FramesError
from me2e_compress.fidelity.compare import compare
from me2e_compress.metrics.measure import Measure
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.latency_trace import Load
from me2e_compress.runtime.profile import processor
from me2e_compress.runtime.session import Session
from me2e_compress.study.cells import EXACT
from me2e_compress.study.definition import Study
from me2e_compress.study.prepared import PreparedVariant
from me2e_compress.study.timing import Clock
from me2e_compress.workflows.result import Listener

LATENCY_PERCENTILES = (50, 99)


@dataclass(frozen=True)
class PlanFidelity:
    """The plan of a variant compared with the baseline's on held-out frames."""

    mean_m: Measure
    max_m: Measure
    plan_sqnr_db: Measure
    frames: int = 0

    @classmethod
    def unknown(cls, reason: str) -> "PlanFidelity":
        """Return the result for a variant that was not compared."""
        metres = Measure(None, "m", reason)
        return cls(metres, metres, Measure(None, "dB", reason))

    def to_json(self) -> dict[str, Any]:
        """Return the three measures with their units, and the number of frames."""
        return {
            "plan_mean": self.mean_m.to_json(),
            "plan_max": self.max_m.to_json(),
            "plan_sqnr": self.plan_sqnr_db.to_json(),
            "frames": self.frames,
        }


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
        latency_ms = {
            percent: clock.latency(name, percent) if prepared.model else unknown
            for percent in LATENCY_PERCENTILES
        }
        size_mb = (
            Measure(None, "MB", why) if size is None else Measure(size / 1e6, "MB")
        )
        return cls(prepared, size_mb, latency_ms, fidelity)

    def to_json(self) -> dict[str, Any]:
        """Return all facts; everything timed is below the key `latency`."""
        prepared, latencies = self.prepared, self.latency_ms.items()
        return {
            "name": self.name,
            "policy": prepared.variant.policy,
            "pipeline": prepared.pipeline or None,
            "model_sha256": prepared.sha256,
            "weights": prepared.weights,
            "size": self.size_mb.to_json(),
            "fidelity": self.fidelity.to_json(),
            "latency": {f"p{percent}": each.to_json() for percent, each in latencies},
        }


def judge(
    study: Study,
    baseline: PreparedVariant,
    prepared: PreparedVariant,
    listener: Listener,
) -> PlanFidelity:
    """Run both models over the held-out frames, and compare their plans.

    A model with another interface is not an error: the result has a reason instead.
    """
    # reasons why there is nothing to compare
    if study.held_out is None:
        return PlanFidelity.unknown("no held-out frames were given")
    if prepared.model is None or baseline.model is None:
        lacks = prepared if prepared.model is None else baseline
        why = prepared.failure or f"{lacks.variant.name} is not a model"
        return PlanFidelity.unknown(why)
    if prepared is baseline:
        return PlanFidelity.unknown("the baseline itself")
    # both models over all held-out frames
    recording = CalibrationSet(study.held_out)
    stage = f"fidelity of {prepared.variant.name}"
    left, right = (
        Session(path, provider=study.provider)
        for path in (baseline.model, prepared.model)
    )

    def reported() -> Iterator[Frame]:
        for frame in recording:
            listener.on_progress(stage, frame.index, len(recording), "frames")
            yield frame

    try:
        fidelity = compare(left, right, reported())
    except (EvaluationError, FramesError) as error:
        return PlanFidelity.unknown(str(error))
    if fidelity.plan is None:
        return PlanFidelity.unknown(fidelity.plan_reason)
    # an identical plan has an infinite ratio
    noise = {each.name: each.sqnr_db for each in fidelity.outputs}[fidelity.plan_output]
    sqnr = Measure(None, "dB", EXACT if noise == math.inf else "no plan")
    if math.isfinite(noise):
        sqnr = Measure(noise, "dB")
    mean_m, max_m = fidelity.plan.mean_m, fidelity.plan.max_m
    metres = Measure(mean_m, "m"), Measure(max_m, "m")
    return PlanFidelity(*metres, sqnr, fidelity.frames)


def this_machine(load: Load | None = None) -> str:
    """Name processor, cores and system, and a load that makes latencies doubtful."""
    cores = f"{os.cpu_count() or 1} cores"
    named = f"{processor()}, {cores}, {platform.system()} {platform.machine()}"
    return f"{named}; {load}" if load is not None and load.busy else named
