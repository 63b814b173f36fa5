"""The four measures of EER_AV, route by route."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from me2e_compress.metrics.comfort import comfort
from me2e_compress.metrics.driving_score import route_score
from me2e_compress.metrics.efficiency import CHECKPOINTS, efficiency
from me2e_compress.metrics.episode import Episode

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class RouteMeasures:
    """The measures of one variant on every route: arrays [routes], NaN if not measured.

    Driving score and efficiency are percentages, comfort is a ratio, the energy is that
    of the whole route. The driving score is never NaN.
    """

    driving_score: Floats
    efficiency: Floats
    comfort: Floats
    energy_j: Floats
    crashed: npt.NDArray[np.bool_]

    @classmethod
    def of_table(cls, table: Floats, crashed: npt.NDArray[np.bool_]) -> Self:
        """Build from a table [routes, 4], as `table` returns it."""
        return cls(table[:, 0], table[:, 1], table[:, 2], table[:, 3], crashed)

    def table(self) -> Floats:
        """Return [routes, 4]: driving score, efficiency, comfort, energy."""
        columns = self.driving_score, self.efficiency, self.comfort, self.energy_j
        return np.stack(columns, axis=1)


@dataclass(frozen=True, slots=True)
class MeasuredRoute:
    """What the four measures of a route follow from.

    ``inferences`` cost energy. ``recorded`` is false where frames are lacking although
    the driver did not fail: then the record lacks them, not the drive.
    """

    driving_score: float
    completion_percent: float
    efficiency: float | None
    comfort: float | None
    inferences: int
    crashed: bool
    failed: bool
    recorded: bool

    def measures(self, j_per_frame: float | None) -> tuple[float, float, float, float]:
        """Return driving score, efficiency, comfort and joules."""
        efficiency, comfort, joules = self.efficiency, self.comfort, math.nan
        if efficiency is None:
            begun = self.completion_percent >= 100.0 / CHECKPOINTS
            efficiency = math.nan if begun or not self.recorded else 0.0
        if comfort is None:
            comfort = 0.0 if self.recorded else math.nan
        if j_per_frame is not None and (self.inferences or self.failed):
            joules = j_per_frame * self.inferences
        return self.driving_score, efficiency, comfort, joules

    @classmethod
    def of(cls, episode: Episode) -> Self:
        """Measure a driven route."""
        recorded = len(episode.frames) if episode.given is not None else 0
        failed = bool(episode.failure)
        return cls(
            route_score(episode).composed,
            episode.completion_percent,
            efficiency(episode).value,
            comfort(episode).value,
            len(episode.decisions) or recorded,
            episode.collided,
            failed,
            bool(episode.frames) or failed,
        )


def route_measures(
    routes: Sequence[MeasuredRoute], j_per_frame: float | None
) -> RouteMeasures:
    """Return the measures of driven routes, in their order.

    A frame in the paper's joules per frame is one inference (its window is 100 of
    them), so a route costs that times its decisions; simulator frames without a
    decision cost nothing. A real run without a log of decisions has one per recorded
    step, since Bench2Drive's agents do both at once. ``j_per_frame`` is None if it was
    not measured.

    A driver that never passed the first 5 % of a route, or ended it within 20 frames,
    has no efficiency or comfort (equations 6 and 7 leave the route out). Here every
    route has a score (equation 9), so that counts as 0; otherwise the failure would be
    left out too. A route without moving traffic has no efficiency, nor has one without
    recorded frames or decisions.
    """
    rows = [each.measures(j_per_frame) for each in routes]
    return RouteMeasures.of_table(
        np.array(rows, np.float64).reshape(-1, 4),
        np.array([each.crashed for each in routes], np.bool_),
    )
