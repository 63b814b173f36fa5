"""EER_AV: driving quality and energy in one score per variant (equations 8 to 11).

    Q_i = w_DS x_DS + C (w_DE x_DE + w_DC x_DC - w_E x_E),  C = 0 after a collision
    EER_AV = mean over routes of Q_i, here times 100: points

The x are normalized measures of route i; the weights w come from CRITIC. The paper does
not say how it normalizes. Here the smallest value of all compared routes and variants
becomes 0 and the largest 1 (min-max), as in the original CRITIC paper (1995), and the
weights use the same rows. Scores are comparable only within one call, or between calls
that share an `EerScale`.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from me2e_compress.base.errors import EvaluationError
from me2e_compress.metrics.episode import FAILURES
from me2e_compress.metrics.measure import Estimate, mean_estimate
from me2e_compress.metrics.route_scores import CHECKPOINTS
from me2e_compress.metrics.route_summary import RouteSummary

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class RouteMeasures:
    """The measures of one variant on every route, NaN if not measured.

    They are driving score and efficiency in percent, comfort as a ratio, and joules of
    the whole route. The driving score is never NaN.
    """

    table: Floats  # (routes, 4)
    crashed: npt.NDArray[np.bool_]  # (routes,)


def route_measures(
    routes: Sequence[RouteSummary], j_per_frame: float | None
) -> RouteMeasures:
    """Return the measures of driven routes, in their order.

    A frame in the paper's joules per frame is one inference (its window is 100 of
    them), so a route costs that times its decisions. A real run without a log of
    decisions has one per recorded step, since Bench2Drive's agents do both at once.
    ``j_per_frame`` is None if it was not measured.

    A driver that never passed the first 5 % of a route, or ended it within 20 frames,
    has no efficiency or comfort (equations 6 and 7 leave the route out). Here every
    route has a score (equation 9), so that counts as 0: the failure must not vanish.
    """
    rows = list[tuple[float, float, float, float]]()
    for route in routes:
        efficiency, comfort, joules = route.efficiency, route.comfort, math.nan
        # Without frames the record lacks them, not the drive, unless the driver failed
        failed = route.ending in FAILURES
        recorded = bool(route.duration_us) or failed
        if efficiency is None:
            begun = route.completion >= 100.0 / CHECKPOINTS
            efficiency = math.nan if begun or not recorded else 0.0
        if comfort is None:
            comfort = 0.0 if recorded else math.nan
        if j_per_frame is not None and (route.decisions or failed):
            joules = j_per_frame * route.decisions
        rows.append((route.driving_score, efficiency, comfort, joules))
    crashed = np.array([bool(route.collisions) for route in routes], np.bool_)
    return RouteMeasures(np.array(rows, np.float64).reshape(-1, 4), crashed)


MEASURES: tuple[str, ...] = ("driving score", "efficiency", "comfort", "energy")
SIGNS = np.array([1.0, 1.0, 1.0, -1.0])
POINTS = "points"
# A measure whose standard deviation is below this share of its values is constant
FLAT = 1e-12
ALIKE = 1e-9  # below this share, all measures are redundant


@dataclass(frozen=True, slots=True)
class EerScale:
    """Normalization and weights of `MEASURES`: x = (value - offset) / span."""

    weights: tuple[float, ...]  # of each x; they add up to 1
    offset: tuple[float, ...]  # %, %, ratio and joules
    span: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class EerResult:
    """EER_AV of variants on the same routes."""

    # Points by variant, with an interval over routes for fixed weights, or the reason
    # why there is none
    scores: Mapping[str, Estimate]
    # [n] points per route by variant, for paired comparisons
    routes: Mapping[str, Floats]
    scale: EerScale | None  # None if nothing could be scored
    # Number of routes left out of all variants, by the missing measure
    left_out: Mapping[str, int]
    is_scored: npt.NDArray[np.bool_]  # (all routes,)

    @property
    def ranking(self) -> tuple[str, ...]:
        """Names of the variants that have a score, best first."""
        values = {name: estimate.value for name, estimate in self.scores.items()}
        known = [name for name, value in values.items() if value is not None]
        return tuple(sorted(known, key=lambda name: -(values[name] or 0.0)))


def eer(
    variants: Mapping[str, RouteMeasures],
    scale: EerScale | None = None,
    types: Sequence[str] | None = None,
    seed: int = 0,
) -> EerResult:
    """Score variants that drove the same routes, listed in the same order.

    A route on which any variant lacks a measure is left out of all. A variant that
    lacks a measure on every route has no score, and its reason names the measure; the
    others are scored without it. Weights and scales follow from the routes unless
    ``scale`` is given. ``types`` are the routes' scenario types for the intervals; None
    treats each route as its own type.

    Raises:
        EvaluationError: The variants differ in the number of routes.
    """
    if len({len(measures.table) for measures in variants.values()}) > 1:
        raise EvaluationError("EER_AV compares variants on the same routes")
    # Find the variants that can be scored
    missing = dict[str, str]()
    for name, measures in variants.items():
        absent = np.asarray(np.isnan(measures.table).all(axis=0))
        lacks = [m for m, gone in zip(MEASURES, absent, strict=True) if gone]
        missing[name] = f"{' and '.join(lacks)}: not measured" if lacks else ""
    able = {name: measures for name, measures in variants.items() if not missing[name]}
    # Find the routes that have all measures of all of them; count the others' gaps
    is_scored, left_out = np.zeros(0, np.bool_), dict[str, int]()
    if able:
        gone = np.any([np.isnan(measures.table) for measures in able.values()], axis=0)
        is_scored, gaps = ~gone.any(axis=1), gone.sum(axis=0).tolist()
        left_out = {m: n for m, n in zip(MEASURES, gaps, strict=True) if n}
    tables = {name: measures.table[is_scored] for name, measures in able.items()}
    # Normalize each measure by min-max, and weigh it, unless a scale is given
    reason = "" if is_scored.any() else "no route has all four measures"
    if not reason and scale is None:
        rows = np.concatenate(list(tables.values()))  # (variants * routes, 4)
        offset, span = rows.min(axis=0), np.ptp(rows, axis=0)
        span = np.where(span > 0.0, span, 1.0)  # a constant measure has weight 0
        try:
            weights = critic_weights((rows - offset) / span)
            columns = (tuple(row.tolist()) for row in (weights, offset, span))
            scale = EerScale(*columns)
        except EvaluationError as error:
            reason = str(error)
    # Estimate every variant's score, or say why there is none
    scores, routes = dict[str, Estimate](), dict[str, Floats]()
    kinds = types or [str(i) for i in range(len(is_scored))]
    for name, measures in variants.items():
        why = missing[name] or reason
        if why or scale is None:
            scores[name] = Estimate.missing(POINTS, why)
            continue
        # Equation 8: the driving score counts always, the rest without a collision
        x = (tables[name] - np.array(scale.offset)) / np.array(
            scale.span
        )  # (routes, 4)
        terms = x * np.array(scale.weights) * SIGNS
        safe = np.where(measures.crashed[is_scored], 0.0, terms[:, 1:].sum(axis=1))
        routes[name] = np.asarray(100.0 * (terms[:, 0] + safe))
        own_kinds = [kind for kind, keep in zip(kinds, is_scored, strict=True) if keep]
        scores[name] = mean_estimate(routes[name].tolist(), own_kinds, POINTS, seed)
    return EerResult(scores, routes, None if reason else scale, left_out, is_scored)


def critic_weights(rows: Floats) -> Floats:
    """Return [m] weights of m criteria, which add up to 1 (CRITIC).

    A criterion weighs more the more it varies, independently of others (Diakoulaki,
    Mavrotas and Papayannakis 1995), here in the paper's form.

    Equation 10: c_i = sigma_i * sum over j of (1 - abs(r_ij)); equation 11: w_i = c_i /
    sum of c. Sigma is the population's standard deviation, r is Pearson's. A constant
    criterion has weight 0 and is left out of the sums of the others.

    Example: the columns (0, 0, 1, 1), (0, 1, 1, 1) and (0, 1, 0, 1) have sigma 1/2,
    sqrt(3) / 4 and 1/2; r is 1 / sqrt(3) between the middle one and each other, and 0
    between those two. So c is (2 - 1 / sqrt(3)) / 2 = 0.711, (sqrt(3) - 1) / 2 = 0.366
    and 0.711, and the weights are 0.398, 0.205 and 0.398.

    Args:
        rows: [n, m] finite, normalized values, one row per observation.

    Raises:
        EvaluationError: All criteria but one are constant, or all are redundant.
    """
    # Leave out constant criteria
    spread = rows.std(axis=0)
    varies = spread > FLAT * np.abs(rows).max(axis=0, initial=0.0)
    content = np.zeros(rows.shape[1])
    if varies.sum() > 1:
        correlation = np.atleast_2d(np.corrcoef(rows[:, varies], rowvar=False))
        apart = np.clip(1.0 - np.abs(correlation), 0.0, 1.0)
        content[varies] = spread[varies] * apart.sum(axis=1)
    # Divide by the sum; fully correlated criteria give no weights
    total = float(content.sum())
    if total <= ALIKE * float(spread.sum()) or not varies.any():
        raise EvaluationError(
            f"CRITIC finds no weights: of {rows.shape[1]} measures over {len(rows)} "
            f"rows {int(varies.sum())} vary, and none tells what another does not"
        )
    return content / total
