"""Deviation of a variant's plan from the baseline's, before anything drives."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.errors import EvaluationError, FramesError
from me2e_compress.fidelity.compare import Fidelity, compare
from me2e_compress.metrics.measure import Measure
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.session import Session
from me2e_compress.study.definition import Study
from me2e_compress.study.prepared import PreparedVariant
from me2e_compress.workflows.result import Listener

EXACT = "no noise: equal to the bit"
"""Reason why an unchanged plan has no signal-to-noise ratio."""


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


def judge(
    study: Study,
    baseline: PreparedVariant,
    prepared: PreparedVariant,
    listener: Listener,
) -> PlanFidelity:
    """Run both models over the held-out frames.

    A model with another interface is not an error: the result has a reason instead.
    """
    # reasons why there is nothing to compare
    if study.held_out is None:
        return PlanFidelity.unknown("no held-out frames were given")
    if prepared.model is None or baseline.model is None:
        if prepared.failure:
            return PlanFidelity.unknown(prepared.failure)
        lacks = prepared if prepared.model is None else baseline
        return PlanFidelity.unknown(f"{lacks.variant.name} is not a model")
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

    # models with different interfaces cannot be compared
    try:
        found = compare(left, right, reported())
    except (EvaluationError, FramesError) as error:
        return PlanFidelity.unknown(str(error))
    return _of(found)


def _of(found: Fidelity) -> PlanFidelity:
    if found.plan is None:
        return PlanFidelity.unknown(found.plan_reason)
    noise = {each.name: each.sqnr_db for each in found.outputs}[found.plan_output]
    # an identical plan has an infinite ratio
    sqnr = Measure(noise, "dB") if math.isfinite(noise) else None
    why = EXACT if noise == math.inf else "no plan"
    return PlanFidelity(
        Measure(found.plan.mean_m, "m"),
        Measure(found.plan.max_m, "m"),
        sqnr or Measure(None, "dB", why),
        found.frames,
    )
