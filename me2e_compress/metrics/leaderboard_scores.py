"""Scores of a set of records, as the simulator wrote them and as computed here.

Bench2Drive's tools/merge_route_json.py divides by 220 however many records there are,
so that a missing route counts as zero; the quotients over the whole set and over the
records are both given here.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from me2e_compress.metrics.bench2drive import success
from me2e_compress.metrics.driving_score import route_score
from me2e_compress.metrics.episode import Episode
from me2e_compress.metrics.measure import Measure
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
    product of the factors of all infractions. A success has status Completed or Perfect
    and no infraction but low speed.
    """

    set_size: int
    driven: int
    given_score: Quotients
    given_completion: Quotients
    given_penalty: Quotients
    score: Quotients
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
                "driving_score": self.score.to_json(),
                "penalty": self.penalty.to_json(),
                "success_rate": self.success_rate.to_json(),
            },
        }


def leaderboard_scores(
    episodes: Sequence[Episode], set_size: int = FULL_SET
) -> LeaderboardScores:
    """Score a set of records as the leaderboard and as Bench2Drive's tools do."""
    given = [each.given for each in episodes if each.given is not None]
    scored = [route_score(each) for each in episodes]

    def quotients(values: Sequence[float], unit: str = "%") -> Quotients:
        return Quotients.of(values, set_size, unit)

    return LeaderboardScores(
        set_size,
        len(episodes),
        given_score=quotients([each.composed_percent for each in given]),
        given_completion=quotients([each.completion_percent for each in given]),
        given_penalty=quotients([each.penalty for each in given], "ratio"),
        score=quotients([each.composed for each in scored]),
        penalty=quotients([each.penalty for each in scored], "ratio"),
        success_rate=quotients([100.0 * success(each) for each in episodes]),
    )
