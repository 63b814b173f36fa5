"""Plans of two models against the recorded drive, frame by frame."""

import dataclasses
from collections.abc import Mapping
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from me2e_compress.errors import EvaluationError, GraphError
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.plan_adapter import PlanAdapter
from me2e_compress.runtime.recorded_future import STEP_S, STEPS, RecordedFuture

Floats: TypeAlias = npt.NDArray[np.float64]
Outputs: TypeAlias = Mapping[str, Array]

MOVED_M = 0.2
"""From step to step, below which the ego keeps its heading."""

_TIMES_S = STEP_S * np.arange(1, STEPS + 1)
_COMMAND = "command"


@dataclasses.dataclass(frozen=True, eq=False)
class JudgedPlans:
    """Both plans of one frame of a scene.

    ``apart_m`` [2, 6] is each plan's distance from the recorded position, step by step;
    ``hits`` [2, 6] is 1 where its box touches another's, None where boxes are not
    known.
    """

    scene: int
    apart_m: Floats
    hits: Floats | None


class OpenLoopTally:
    """Distances and collisions, frame by frame.

    Where neither an input nor scores pick the plan's mode, the recorded command does.
    ``judged`` holds the plans of every frame whose next three seconds are known,
    ``left_out`` counts the others; ``reach_s`` is how far all plans reach, at most
    three seconds; ``reason`` says why nothing is judged, if so.
    """

    def __init__(self, adapter: PlanAdapter) -> None:
        if adapter.command_input is None and adapter.scores is None:
            adapter = adapter.model_copy(update={"command_input": _COMMAND})
        self._adapter = adapter
        self._scene = 0
        self.judged = list[JudgedPlans]()
        self.left_out = 0
        self.reach_s = float(_TIMES_S[-1])
        self.reason = ""

    def add(self, reference: Outputs, candidate: Outputs, frame: Frame) -> None:
        """Judge the plans of a frame."""
        self._scene += frame.starts_scene
        future = frame.future
        if future is None or not future.whole or self.reason:
            self.left_out += 1
            return
        try:
            plans = [self._plan(each, frame, future) for each in (reference, candidate)]
        except (EvaluationError, GraphError) as error:
            self.reason = str(error)
            return
        # distances to the recorded drive, and collisions
        driven = np.array(future.waypoints, np.float64)
        apart = np.stack([np.linalg.norm(plan - driven, axis=1) for plan in plans])
        self.judged.append(
            JudgedPlans(self._scene, apart, _hits(plans, driven, future))
        )

    def _plan(self, outputs: Outputs, frame: Frame, future: RecordedFuture) -> Floats:
        """Return the waypoints [6, 2] of one model."""
        fed = {_COMMAND: np.array([future.command]), **frame.arrays}
        found = self._adapter.trajectory(self._adapter.plan(outputs, fed))
        self.reach_s = min(self.reach_s, float(found.times_s[-1]))
        return found.at(_TIMES_S)


def _hits(plans: list[Floats], driven: Floats, future: RecordedFuture) -> Floats | None:
    """Return [2, 6]: 1 where a plan's box touches another; None if none are known.

    Steps where the recorded drive itself touches a box (boxes are not exact) do not
    count, as in UniAD and VAD.
    """
    if future.agents is None:
        return None
    found = [
        [
            _touches(box, np.array(others, np.float64).reshape(-1, 5))
            for box, others in zip(ego_boxes(path, future), future.agents, strict=True)
        ]
        for path in (driven, *plans)
    ]
    # a step where the recorded drive touches a box counts for nobody
    recorded, *planned = np.array(found)
    return np.array([each & ~recorded for each in planned], np.float64)


def ego_boxes(path: Floats, future: RecordedFuture) -> Floats:
    """Return the boxes of the ego along a path: x, y, heading, length, width [6, 5].

    Its heading is the direction from the waypoint before; if it hardly moves, the
    heading stays.
    """
    heading, last, found = future.forward, np.zeros(2), list[list[float]]()
    ahead, left = _turned(np.array(future.centre), -future.forward)
    for point in path:
        way = point - last
        if np.hypot(*way) >= MOVED_M:
            heading, last = float(np.arctan2(way[1], way[0])), point
        centre = point + _turned(np.array([ahead, left]), heading)
        found.append([*centre.tolist(), heading, *future.ego])
    return np.array(found)


def _turned(vector: Floats, angle: float) -> Floats:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]]) @ vector


def _touches(box: Floats, others: Floats) -> bool:
    """Return whether a box overlaps one of others [n, 5]: no axis separates them."""
    own, theirs = _axes(box[None]), _axes(others)
    axes = np.concatenate([np.broadcast_to(own, theirs.shape), theirs], axis=1)
    reach = np.abs(axes @ own[0].T) @ (box[3:] / 2)
    reach += np.einsum(
        "nab,nb->na", np.abs(axes @ theirs.transpose(0, 2, 1)), others[:, 3:] / 2
    )
    apart = np.abs(np.einsum("nai,ni->na", axes, others[:, :2] - box[:2])) > reach
    return bool((~apart.any(axis=1)).any())


def _axes(boxes: Floats) -> Floats:
    """Return the unit vectors along and across boxes [n, 2, 2]."""
    cos, sin = np.cos(boxes[:, 2]), np.sin(boxes[:, 2])
    return np.stack(
        [np.stack([cos, sin], axis=1), np.stack([-sin, cos], axis=1)], axis=1
    )
