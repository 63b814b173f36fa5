"""Driving score: route completion times the penalties of infractions."""

import math
from dataclasses import dataclass

from me2e_compress.metrics.episode import Episode
from me2e_compress.metrics.infraction import InfractionKind

DIGITS = 6
"""Digits to which the leaderboard rounds each of the three scores."""


@dataclass(frozen=True, slots=True)
class RouteScore:
    """Scores of one route: route and composed in percent, penalty as a factor."""

    route: float
    penalty: float
    composed: float


def route_score(episode: Episode) -> RouteScore:
    """Return completion, penalty and their product (equation 5, one summand).

    As in the leaderboard (statistics_manager.py of Bench2Drive 0.0.3), every infraction
    multiplies the completed percentage by its factor.
    """
    penalty = math.prod(infraction.factor for infraction in episode.infractions)
    return composed_of(episode.completion_percent, penalty)


def score_to_first_collision(episode: Episode) -> RouteScore:
    """Return the scores that a drive would have if its first collision had ended it.

    That is `route_score` unless the drive went on: one drive is scored by both rules.
    """
    first = episode.first_collision
    if first is None:
        return route_score(episode)
    penalty = 1.0 - first.outside_percent / 100.0
    for each in episode.infractions:
        before = each.time_us is not None and each.time_us <= first.time_us
        if before and each.kind is not InfractionKind.OUTSIDE_ROUTE_LANES:
            penalty *= each.factor
    return composed_of(first.completion_percent, penalty)


def composed_of(route: float, penalty: float) -> RouteScore:
    """Multiply a completion in percent by the factor of all infractions."""
    return RouteScore(
        round(route, DIGITS),
        round(penalty, DIGITS),
        round(max(route * penalty, 0.0), DIGITS),
    )
