"""EER_AV under other normalizations than min-max: whether an order depends on it."""

from collections.abc import Mapping
from dataclasses import replace
from enum import StrEnum

import numpy as np

from me2e_compress.base.errors import EvaluationError
from me2e_compress.metrics.eer import (
    POINTS,
    EerResult,
    EerScale,
    RouteMeasures,
    critic_weights,
    eer,
)
from me2e_compress.metrics.measure import Estimate, Floats


class Normalization(StrEnum):
    """How a measure becomes a number that others may be added to."""

    MIN_MAX = "min-max"
    """Over all routes of all variants: smallest 0, largest 1; the package's."""
    NATURAL = "natural"
    """Driving score and efficiency over 100 %, comfort as it is, energy over the most
    that a route took: no measure but energy hangs on what is compared."""
    Z_SCORE = "z-score"
    """Over all routes of all variants: mean 0, standard deviation 1."""
    VARIANT_MEANS = "variant means"
    """Over the variants' means: smallest 0, largest 1; the weights too."""


def scored(variants: Mapping[str, RouteMeasures]) -> dict[Normalization, EerResult]:
    """Score variants under every normalization; without weights, say why."""
    first = eer(variants)
    tables = [
        variants[name].table[first.is_scored]
        for name, score in first.scores.items()
        if score.value is not None
    ]
    found = dict.fromkeys(Normalization, first)
    for each in found if tables else ():
        if each is Normalization.MIN_MAX:
            continue
        try:
            found[each] = eer(variants, _scale_of(tables, each))
        except EvaluationError as error:
            why = Estimate.missing(POINTS, str(error))
            scores = {
                name: score if score.value is None else why
                for name, score in first.scores.items()
            }
            found[each] = replace(first, scores=scores, routes={}, scale=None)
    return found


def _scale_of(tables: list[Floats], normalization: Normalization) -> EerScale:
    """Return offset, span and CRITIC weights of every measure, from complete tables."""
    # the values that the scale is taken over
    rows = np.concatenate(tables)
    if normalization is Normalization.VARIANT_MEANS:
        rows = np.stack([table.mean(axis=0) for table in tables])
    # offset and span by the normalization
    if normalization is Normalization.Z_SCORE:
        offset, span = rows.mean(axis=0), rows.std(axis=0)
    elif normalization is Normalization.NATURAL:
        offset = np.zeros(rows.shape[1])
        span = np.array([100.0, 100.0, 1.0, rows[:, 3].max()])
    else:
        offset, span = rows.min(axis=0), np.ptp(rows, axis=0)
    span = np.where(span > 0.0, span, 1.0)  # a constant measure has weight 0
    weights = critic_weights((rows - offset) / span)
    return EerScale(_four(weights), _four(offset), _four(span))


def _four(values: Floats) -> tuple[float, float, float, float]:
    one, two, three, four = values.tolist()
    return one, two, three, four
