"""The four measures of EER_AV, route by route."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from me2e_compress.metrics.efficiency import CHECKPOINTS
from me2e_compress.metrics.episode import FAILURES
from me2e_compress.metrics.route_summary import RouteSummary

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class RouteMeasures:
    """The measures of one variant on every route.

    ``table`` is [routes, 4], NaN if not measured: driving score and efficiency in
    percent, comfort as a ratio, joules of the whole route. The driving score is never
    NaN. ``crashed`` is [routes].
    """

    table: Floats
    crashed: npt.NDArray[np.bool_]


def route_measures(
    routes: Sequence[RouteSummary], j_per_frame: float | None
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
    rows = [_measures(each, j_per_frame) for each in routes]
    return RouteMeasures(
        np.array(rows, np.float64).reshape(-1, 4),
        np.array([bool(each.collisions) for each in routes], np.bool_),
    )


def _measures(
    route: RouteSummary, j_per_frame: float | None
) -> tuple[float, float, float, float]:
    efficiency, comfort, joules = route.efficiency, route.comfort, math.nan
    # without frames the record lacks them, not the drive, unless the driver failed
    failed = route.ending in FAILURES
    recorded = bool(route.duration_us) or failed
    if efficiency is None:
        begun = route.completion >= 100.0 / CHECKPOINTS
        efficiency = math.nan if begun or not recorded else 0.0
    if comfort is None:
        comfort = 0.0 if recorded else math.nan
    if j_per_frame is not None and (route.decisions or failed):
        joules = j_per_frame * route.decisions
    return route.driving_score, efficiency, comfort, joules
