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


def route_measures(
    episodes: Sequence[Episode], j_per_frame: float | None
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
    return RouteMeasures(
        np.array([route_score(each).composed for each in episodes], np.float64),
        np.array([_efficiency(each) for each in episodes], np.float64),
        np.array([_comfort(each) for each in episodes], np.float64),
        np.array([_joules(each, j_per_frame) for each in episodes], np.float64),
        np.array([each.collided for each in episodes], np.bool_),
    )


def _efficiency(episode: Episode) -> float:
    found = efficiency(episode).value
    if found is not None:
        return found
    begun = episode.completion_percent >= 100.0 / CHECKPOINTS
    return math.nan if begun or not _recorded(episode) else 0.0


def _comfort(episode: Episode) -> float:
    found = comfort(episode).value
    if found is not None:
        return found
    return 0.0 if _recorded(episode) else math.nan


def _joules(episode: Episode, j_per_frame: float | None) -> float:
    recorded = len(episode.frames) if episode.given is not None else 0
    inferences = len(episode.decisions) or recorded
    if j_per_frame is None or not (inferences or episode.failure):
        return math.nan
    return j_per_frame * inferences


def _recorded(episode: Episode) -> bool:
    """Return whether a lack of frames is the driver's failure, not the record's."""
    return bool(episode.frames or episode.failure)
