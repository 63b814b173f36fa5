"""L2 and collisions of two plans on recorded driving, with intervals.

They are given at 1, 2 and 3 s, by both conventions of the field: *at* the horizon
(UniAD), and as the mean *up to* it (ST-P3, VAD), which is the smaller number.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from me2e_compress.display import Table, counted, number, table
from me2e_compress.errors import EvaluationError, GraphError
from me2e_compress.metrics.intervals import mean_estimate
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.plan_adapter import PlanAdapter
from me2e_compress.runtime.recorded_future import STEP_S, STEPS, RecordedFuture

Floats: TypeAlias = npt.NDArray[np.float64]
Outputs: TypeAlias = Mapping[str, Array]
Kind: TypeAlias = Literal["l2", "collision"]
Convention: TypeAlias = Literal["at", "up-to"]

HORIZONS_S = (1, 2, 3)
CONVENTIONS: tuple[Convention, ...] = ("at", "up-to")
NO_FUTURE = "no frame says what happened in the three seconds after it"
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


@dataclasses.dataclass(frozen=True)
class PlanQuality:
    """One number of both plans, a mean over frames.

    Attributes:
        measure: ``l2`` or ``collision``: distance to where the ego went, or share of
            plans that collide.
        unit: m or %; a difference of shares is in percentage points.
        convention: ``at`` the horizon (UniAD) or mean ``up-to`` it (VAD, ST-P3).
        reference: the number of the first model's plan.
        candidate: the number of the second model's plan.
        difference: the second minus the first; frame by frame.
        low: 95 % interval over other moments of these scenes; None, like `high`,
            where they are too few.
        anew_low: over scenes drawn anew.
    """

    measure: Kind
    unit: Literal["m", "%"]
    convention: Convention
    horizon_s: int
    reference: float
    candidate: float
    difference: float
    low: float | None
    high: float | None
    anew_low: float | None
    anew_high: float | None

    @property
    def title(self) -> str:
        """The measure, convention, horizon and unit."""
        what = "L2" if self.measure == "l2" else "collisions"
        when = "at" if self.convention == "at" else "to"
        return f"{what} {when} {self.horizon_s} s, {self.unit}"


@dataclasses.dataclass(frozen=True)
class OpenLoop:
    """Both plans against the recorded future.

    Attributes:
        frames: number of frames whose next three seconds are known.
        scenes: number of scenes that these are from.
        left_out: number of other frames.
        qualities: L2, then collisions; these only count frames that know the other road
            users; horizons that a plan does not reach are left out.
    """

    frames: int
    scenes: int
    left_out: int
    qualities: tuple[PlanQuality, ...]

    @classmethod
    def of(cls, tally: OpenLoopTally) -> "OpenLoop | str":
        """Return what a tally found, or the reason why it found nothing."""
        if tally.reason or not tally.judged:
            return tally.reason or NO_FUTURE
        return cls(
            len(tally.judged),
            len({each.scene for each in tally.judged}),
            tally.left_out,
            tuple(_qualities(tally)),
        )

    def table(self) -> Table:
        """Return one row per number."""
        # each row shows both plans, then their difference with two intervals
        rows = [
            (
                each.title,
                f"{each.reference:.2f}",
                f"{each.candidate:.2f}",
                number(each.difference, "+.2f"),
                _between(each.low, each.high),
                _between(each.anew_low, each.anew_high),
            )
            for each in self.qualities
        ]
        return table(
            "Plans against what was really driven",
            ("mean", "first", "second", "differ", "95 %", "scenes anew"),
            rows,
            f"Over {counted(self.frames, 'frame')} of {counted(self.scenes, 'scene')}"
            f" whose next three seconds are known ({self.left_out} others are left"
            " out). At a horizon is UniAD's convention, the mean up to it that of ST-P3"
            " and VAD.",
        )


def _qualities(tally: OpenLoopTally) -> Iterator[PlanQuality]:
    horizons = [each for each in HORIZONS_S if each <= tally.reach_s]
    apart = [(each.scene, each.apart_m) for each in tally.judged]
    hits = [(each.scene, each.hits) for each in tally.judged if each.hits is not None]
    for convention in CONVENTIONS:
        for horizon in horizons:
            yield _quality("l2", convention, horizon, apart)
    for convention in CONVENTIONS if hits else ():
        for horizon in horizons:
            yield _quality("collision", convention, horizon, hits)


def _quality(
    measure: Kind,
    convention: Convention,
    horizon_s: int,
    values: Sequence[tuple[int, npt.NDArray[np.float64]]],
) -> PlanQuality:
    # up to a horizon the half seconds are averaged, at it only the last counts
    last = round(horizon_s / STEP_S)
    span = slice(last - 1 if convention == "at" else 0, last)
    # collisions become percent; each row is a frame, its columns the two plans
    unit: Literal["m", "%"] = "m" if measure == "l2" else "%"
    each = np.array([of[:, span].mean(axis=1) for _, of in values])
    each *= 1.0 if measure == "l2" else 100.0
    reference, candidate = each.mean(axis=0).tolist()
    # the interval is that of the difference, with scenes as clusters
    estimate = mean_estimate(
        (each[:, 1] - each[:, 0]).tolist(),
        [str(scene) for scene, _ in values],
        unit,
        bounds=None if measure == "l2" else (-100.0, 100.0),
    )
    return PlanQuality(
        measure,
        unit,
        convention,
        horizon_s,
        reference,
        candidate,
        candidate - reference,
        estimate.low,
        estimate.high,
        estimate.anew_low,
        estimate.anew_high,
    )


def _between(low: float | None, high: float | None) -> str:
    if low is None or high is None:
        return "-"
    return f"{number(low, '+.2f')} to {number(high, '+.2f')}"
