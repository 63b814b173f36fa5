"""Scores of records by the rules of each version of the CARLA leaderboard.

The factors are those of statistics_manager.py of carla-simulator/leaderboard, branches
leaderboard-1.0, -2.0 and -2.1, and of Bench2Drive's copy of it (0.0.3 and 0.0.4). Its
tools/merge_route_json.py divides by 220 however many records there are, so that a
missing route counts as zero; the quotients over the whole set and over the records are
both given here.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from types import MappingProxyType
from typing import Any, Literal, get_args

from me2e_compress.metrics.bench2drive import success
from me2e_compress.metrics.driving_score import RouteScore, composed_of
from me2e_compress.metrics.episode import Episode
from me2e_compress.metrics.infraction import PENALTY, Infraction, InfractionKind
from me2e_compress.metrics.measure import Measure
from me2e_compress.metrics.scores import FULL_SET

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
        lanes = InfractionKind.OUTSIDE_ROUTE_LANES
        outside = math.prod(e.factor for e in episode.infractions if e.kind is lanes)
        costs = [self._cost(e) for e in episode.infractions if e.kind is not lanes]
        if self.summed:
            return outside / (1.0 + sum(costs))
        return outside * math.prod(costs)

    def _cost(self, infraction: Infraction) -> float:
        """Return the factor of an infraction, or its summand."""
        free = 0.0 if self.summed else 1.0
        if infraction.kind is InfractionKind.MIN_SPEED:
            slow = self.min_speed * _slowness(infraction)
            return slow if self.summed else 1.0 - slow
        return self.costs.get(infraction.kind, free)


def _slowness(infraction: Infraction) -> float:
    """Return how far the ego fell behind the traffic, 0 to 1."""
    percent = 100.0 if infraction.percent is None else infraction.percent
    return max(0.0, 1.0 - percent / 100.0)


_TIMED_OUT = (
    InfractionKind.SCENARIO_TIMEOUT,
    InfractionKind.YIELD_TO_EMERGENCY_VEHICLE,
)
_SUMMANDS = {
    InfractionKind.COLLISION_PEDESTRIAN: 1.0,
    InfractionKind.COLLISION_VEHICLE: 0.7,
    InfractionKind.COLLISION_LAYOUT: 0.6,
    InfractionKind.RED_LIGHT: 0.4,
    InfractionKind.STOP: 0.25,
    InfractionKind.GIVE_WAY: 0.25,  # ours: as much as a stop sign
    **dict.fromkeys(_TIMED_OUT, 0.4),
}

LEADERBOARDS: Mapping[Version, LeaderboardPenalties] = MappingProxyType(
    {
        "b2d": LeaderboardPenalties(PENALTY),
        "1.0": LeaderboardPenalties({**PENALTY, **dict.fromkeys(_TIMED_OUT, 1.0)}),
        "2.0": LeaderboardPenalties(PENALTY, min_speed=0.3),
        "2.1": LeaderboardPenalties(_SUMMANDS, min_speed=0.4, summed=True),
    }
)


def score_under(episode: Episode, version: Version) -> RouteScore:
    """Return completion, penalty and their product under the rules of a version."""
    penalty = LEADERBOARDS[version].penalty(episode)
    return composed_of(episode.completion_percent, penalty)


@dataclass(frozen=True, slots=True)
class Quotients:
    """One sum over records, divided by the size of the set or by the records."""

    over_set: Measure
    over_driven: Measure

    @classmethod
    def of(cls, values: Sequence[float], set_size: int, unit: str) -> "Quotients":
        """Divide the sum of one value per record."""
        if not values:
            nothing = Measure(None, unit, "there is no record")
            return cls(nothing, nothing)
        return cls(Measure(sum(values) / set_size, unit), Measure(fmean(values), unit))

    def to_json(self) -> dict[str, float | None]:
        """Return both values."""
        return {"set": self.over_set.value, "driven": self.over_driven.value}


@dataclass(frozen=True, slots=True)
class LeaderboardScores:
    """Scores of a set of records, as given by the simulator and as computed here.

    Driving scores, completion and success rate are percentages; a penalty is the
    product of the factors of all infractions. ``score_without_low_speed`` leaves out
    the penalty of low speed: Bench2Drive writes about 20 check points per route, the
    leaderboard has 4. A success has status Completed or Perfect and no infraction but
    low speed.
    """

    penalties: Version
    set_size: int
    driven: int
    given_score: Quotients
    given_completion: Quotients
    given_penalty: Quotients
    score: Quotients
    score_without_low_speed: Quotients
    penalty: Quotients
    success_rate: Quotients

    def to_json(self) -> dict[str, Any]:
        """Return given and computed scores, apart."""
        return {
            "given": {
                "driving_score": self.given_score.to_json(),
                "completion": self.given_completion.to_json(),
                "penalty": self.given_penalty.to_json(),
            },
            "computed": {
                "penalties": self.penalties,
                "driving_score": self.score.to_json(),
                "driving_score_without_low_speed": (
                    self.score_without_low_speed.to_json()
                ),
                "penalty": self.penalty.to_json(),
                "success_rate": self.success_rate.to_json(),
            },
        }


def leaderboard_scores(
    episodes: Sequence[Episode], penalties: Version = "b2d", set_size: int = FULL_SET
) -> LeaderboardScores:
    """Score a set of records as the leaderboard and as Bench2Drive's tools do."""
    # values as given, computed, and without low speed
    given = [each.given for each in episodes if each.given is not None]
    scored = [score_under(each, penalties) for each in episodes]
    unhurried = [_without_low_speed(each, penalties) for each in episodes]

    def quotients(values: Sequence[float], unit: str = "%") -> Quotients:
        return Quotients.of(values, set_size, unit)

    return LeaderboardScores(
        penalties,
        set_size,
        len(episodes),
        given_score=quotients([each.composed_percent for each in given]),
        given_completion=quotients([each.completion_percent for each in given]),
        given_penalty=quotients([each.penalty for each in given], "ratio"),
        score=quotients([each.composed for each in scored]),
        score_without_low_speed=quotients(unhurried),
        penalty=quotients([each.penalty for each in scored], "ratio"),
        success_rate=quotients([100.0 * success(each) for each in episodes]),
    )


def _without_low_speed(episode: Episode, penalties: Version) -> float:
    fast = [e for e in episode.infractions if e.kind is not InfractionKind.MIN_SPEED]
    return score_under(replace(episode, infractions=tuple(fast)), penalties).composed
