"""Penalties of infractions by the rules of each version of the CARLA leaderboard.

The factors are those of statistics_manager.py of carla-simulator/leaderboard, branches
leaderboard-1.0, -2.0 and -2.1, and of Bench2Drive's copy of it (0.0.3 and 0.0.4).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, get_args

from me2e_compress.metrics.driving_score import RouteScore, composed_of
from me2e_compress.metrics.episode import Episode
from me2e_compress.metrics.infraction import PENALTY, Infraction, InfractionKind

Version = Literal["b2d", "1.0", "2.0", "2.1"]
VERSIONS: tuple[Version, ...] = get_args(Version)


@dataclass(frozen=True, slots=True)
class LeaderboardPenalties:
    """The rules of one version.

    Attributes:
        costs: Factor by kind of infraction, or summand c of 1 / (1 + sum c) if
            `summed`; a kind that is not listed costs nothing.
        min_speed: Penalty of a check point passed at no speed. At v % of the traffic's
            speed it is (1 - v/100) times that, and nothing from 100 % on.
    """

    costs: Mapping[InfractionKind, float]
    min_speed: float = 0.0
    summed: bool = False

    def penalty(self, episode: Episode) -> float:
        """Return the combined factor of all infractions of a route.

        In every version, leaving the lanes costs the share of the way driven outside.
        """
        outside = math.prod(
            each.factor
            for each in episode.infractions
            if each.kind is InfractionKind.OUTSIDE_ROUTE_LANES
        )
        others = [
            each
            for each in episode.infractions
            if each.kind is not InfractionKind.OUTSIDE_ROUTE_LANES
        ]
        if self.summed:
            return outside / (1.0 + sum(self._summand(each) for each in others))
        return outside * math.prod(self._factor(each) for each in others)

    def _factor(self, infraction: Infraction) -> float:
        if infraction.kind is InfractionKind.MIN_SPEED:
            return 1.0 - self.min_speed * _slowness(infraction)
        return self.costs.get(infraction.kind, 1.0)

    def _summand(self, infraction: Infraction) -> float:
        if infraction.kind is InfractionKind.MIN_SPEED:
            return self.min_speed * _slowness(infraction)
        return self.costs.get(infraction.kind, 0.0)


def _slowness(infraction: Infraction) -> float:
    """Return how far the ego fell behind the traffic, 0 to 1."""
    percent = 100.0 if infraction.percent is None else infraction.percent
    return max(0.0, 1.0 - percent / 100.0)


def _costs(
    pedestrian: float, vehicle: float, layout: float, light: float, stop: float
) -> dict[InfractionKind, float]:
    return {
        InfractionKind.COLLISION_PEDESTRIAN: pedestrian,
        InfractionKind.COLLISION_VEHICLE: vehicle,
        InfractionKind.COLLISION_LAYOUT: layout,
        InfractionKind.RED_LIGHT: light,
        InfractionKind.STOP: stop,
        InfractionKind.GIVE_WAY: stop,  # ours: as much as a stop sign
    }


_TIMED_OUT = (
    InfractionKind.SCENARIO_TIMEOUT,
    InfractionKind.YIELD_TO_EMERGENCY_VEHICLE,
)
_FACTORS = _costs(0.5, 0.6, 0.65, 0.7, 0.8)

LEADERBOARDS: Mapping[Version, LeaderboardPenalties] = MappingProxyType(
    {
        "b2d": LeaderboardPenalties(PENALTY),
        "1.0": LeaderboardPenalties(_FACTORS),
        "2.0": LeaderboardPenalties(
            _FACTORS | dict.fromkeys(_TIMED_OUT, 0.7), min_speed=0.3
        ),
        "2.1": LeaderboardPenalties(
            _costs(1.0, 0.7, 0.6, 0.4, 0.25) | dict.fromkeys(_TIMED_OUT, 0.4),
            min_speed=0.4,
            summed=True,
        ),
    }
)


def score_under(episode: Episode, version: Version) -> RouteScore:
    """Return completion, penalty and their product under the rules of a version."""
    penalty = LEADERBOARDS[version].penalty(episode)
    return composed_of(episode.completion_percent, penalty)
