"""Bench2Drive's scores of a set of records, over the whole set and over the records.

tools/merge_route_json.py divides by 220 however many records there are, so that a
missing route counts as zero; both quotients are given here.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any

from me2e_compress.metrics.bench2drive import success
from me2e_compress.metrics.episode import Episode
from me2e_compress.metrics.infraction import InfractionKind
from me2e_compress.metrics.measure import Measure
from me2e_compress.metrics.penalties import LEADERBOARDS, Version, score_under
from me2e_compress.metrics.scores import FULL_SET


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
    if not LEADERBOARDS[penalties].min_speed:
        return score_under(episode, penalties).composed
    return score_under(
        replace(
            episode,
            infractions=tuple(
                each
                for each in episode.infractions
                if each.kind is not InfractionKind.MIN_SPEED
            ),
        ),
        penalties,
    ).composed
