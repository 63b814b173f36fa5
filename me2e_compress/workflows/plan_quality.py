"""L2 and collisions of two plans on recorded driving, with intervals.

They are given at 1, 2 and 3 s, and by both conventions of the field: *at* the horizon
(UniAD), and as the mean over the half seconds *up to* it (ST-P3, VAD), which is the
smaller number. A plan that repeats the recorded one may still drive badly.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from me2e_compress.fidelity.open_loop import OpenLoopTally
from me2e_compress.metrics.intervals import mean_estimate
from me2e_compress.runtime.recorded_future import STEP_S
from me2e_compress.workflows.result import Table, counted, number, table

Kind: TypeAlias = Literal["l2", "collision"]
Convention: TypeAlias = Literal["at", "up-to"]

HORIZONS_S = (1, 2, 3)
CONVENTIONS: tuple[Convention, ...] = ("at", "up-to")
NO_FUTURE = "no frame says what happened in the three seconds after it"


@dataclasses.dataclass(frozen=True)
class PlanQuality:
    """One number of both plans, a mean over frames.

    Attributes:
        measure: distance to where the ego went, or share of plans that collide.
        unit: m or %; a difference of shares is in percentage points.
        convention: what a horizon means, see the module.
        reference: the number of the first model's plan.
        candidate: the number of the second model's plan.
        difference: the second minus the first, frame by frame.
        low: lower end of the difference's 95 % interval over other moments of these
            scenes; None, like `high`, where they are too few.
        anew_low: lower end of the wider interval over scenes drawn anew.
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
        qualities: L2, then collisions, which only count frames that know the other road
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
