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
    """What one variant did on every route: arrays [routes], in one order of routes.

    Attributes:
        driving_score: Percent.
        efficiency: Percent; NaN where it was not measured.
        comfort: Ratio; NaN where it was not measured.
        energy_j: Joules for the whole route; NaN where it was not measured.
        crashed: Whether the ego hit anything.
    """

    driving_score: Floats
    efficiency: Floats
    comfort: Floats
    energy_j: Floats
    crashed: npt.NDArray[np.bool_]

    @classmethod
    def of_table(cls, table: Floats, crashed: npt.NDArray[np.bool_]) -> Self:
        """Build them of a table [routes, 4], as `table` returns it."""
        return cls(table[:, 0], table[:, 1], table[:, 2], table[:, 3], crashed)

    def table(self) -> Floats:
        """Return [routes, 4]: driving score, efficiency, comfort, energy."""
        columns = self.driving_score, self.efficiency, self.comfort, self.energy_j
        return np.stack(columns, axis=1)


def route_measures(
    episodes: Sequence[Episode], j_per_frame: float | None
) -> RouteMeasures:
    """Return the measures of driven routes, in their order.

    A frame of the paper's joules a frame is an inference (its window is 100 of them),
    so a route costs joules a frame times its decisions: frames of the world in which
    the policy was not asked cost nothing. A real run without a log of decisions has one
    for each step that the agent recorded, as Bench2Drive's agents do both in one.

    A driver that never passed the first 5 % of a route, or ended it within 20 frames,
    has no efficiency or comfort to average (equations 6 and 7 leave the route out);
    here, where every route has a score (equation 9), that counts as 0, or its failure
    would be left out with the route. A route on which no traffic was seen moving has
    no efficiency at all, and neither has one without a record of frames or decisions.

    Args:
        episodes: One a route.
        j_per_frame: Joules of one inference; None: not measured.
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
