"""Check a policy's answer, and bring it into one form."""

import numpy as np
import numpy.typing as npt

from me2e_compress.driving.contract import (
    PLAN_SHAPE,
    PLAN_STEP_US,
    PedalsAndWheel,
    Plan,
)
from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.trajectory import Trajectory

PLAN_TIMES_S = (1 + np.arange(PLAN_SHAPE[0])) * (PLAN_STEP_US / 1e6)
"""Times of the waypoints of a `Plan`, seconds."""

RANGES = {"throttle": (0.0, 1.0), "steer": (-1.0, 1.0), "brake": (0.0, 1.0)}
"""Ranges of the controls in `PedalsAndWheel`."""


def checked(answer: object) -> Trajectory | PedalsAndWheel:
    """Return a policy's answer, a plan with the times of its waypoints.

    Raises:
        EvaluationError: It has another form or shape, is not finite, or is out of
            range.
    """
    if isinstance(answer, PedalsAndWheel):
        return _in_range(answer)
    if isinstance(answer, Trajectory):
        return Trajectory(_finite(answer.points), np.asarray(answer.times_s))
    # an array of six waypoints
    if not isinstance(answer, np.ndarray) or answer.dtype.kind != "f":
        raise EvaluationError(f"the plan is not a float array but {_kind(answer)}")
    if answer.shape != PLAN_SHAPE:
        raise EvaluationError(
            f"the plan has shape {list(answer.shape)}, it must be {list(PLAN_SHAPE)}"
        )
    return Trajectory(_finite(answer), PLAN_TIMES_S)


def timed(plan: Plan | Trajectory) -> Trajectory:
    """Return a plan with the times of its waypoints."""
    return plan if isinstance(plan, Trajectory) else Trajectory(plan, PLAN_TIMES_S)


def six_waypoints(answer: object) -> npt.NDArray[np.float64]:
    """Return a plan as six waypoints every 0.5 s, interpolated if need be."""
    found = checked(answer)
    if isinstance(found, PedalsAndWheel):
        raise EvaluationError("the policy answers controls: there is no plan")
    if np.array_equal(found.times_s, PLAN_TIMES_S):
        return np.asarray(found.points, np.float64)
    return found.at(PLAN_TIMES_S)


def _finite(points: Plan) -> Plan:
    if not np.isfinite(points).all():
        raise EvaluationError("the plan is not finite")
    return points.astype(np.float64)


def _in_range(control: PedalsAndWheel) -> PedalsAndWheel:
    for name, (low, high) in RANGES.items():
        value = getattr(control, name)
        if not low <= value <= high:  # which NaN is not either
            raise EvaluationError(
                f"{name} is {value:g}, it must be from {low:g} to {high:g}"
            )
    return control


def _kind(answer: object) -> str:
    if isinstance(answer, np.ndarray):
        return f"an array of {answer.dtype}"
    return type(answer).__name__
