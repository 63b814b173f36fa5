"""How many frames a decision is in force."""

import numpy as np

from me2e_compress.driving.latency import DecisionFacts
from me2e_compress.driving.realtime import LatencyModel, skipped_decisions
from me2e_compress.study.condition import Condition
from me2e_compress.study.definition import Study


def frames_per_decision(study: Study, condition: Condition) -> int:
    """Return the number of frames that a decision is in force: n + 1 of equation 4.

    Frames are the condition's steps. For a trace, or a mean of one, it is based on the
    baseline's median on the device, if the study states it, with no road users in view.
    """
    if condition.drive.latency_model is LatencyModel.FIFO:
        return 1
    if condition.mean_of:
        return frames_per_decision(study, study.drive_of(condition.mean_of)[1])
    latency_us = round(1e6 * (study.timing.baseline_median_s or 0.0))
    source = condition.source(study.seed).with_trace((latency_us,), 1.0)
    nobody = DecisionFacts(latency_us, np.empty((0, 2)))
    latency_us = source.on_route("")(nobody)
    return skipped_decisions(latency_us, condition.drive.dt_us) + 1
