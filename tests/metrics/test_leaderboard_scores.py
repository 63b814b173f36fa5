import dataclasses

import pytest

from me2e_compress.metrics.bench2drive import ability_rates
from me2e_compress.metrics.episode import Ending, Episode, Given, InfractionKind
from me2e_compress.metrics.scores import leaderboard_scores
from tests.metrics.drives import drive, infraction

SIGNS = ("Merging", "Traffic_Signs")
RAMMED = infraction(InfractionKind.COLLISION_VEHICLE)
RAN_STOP = infraction(InfractionKind.STOP)
SLOW = infraction(InfractionKind.MIN_SPEED, percent=50.0)


def given(episode: Episode, status: str, composed: float) -> Episode:
    said = Given(status, episode.completion_percent, 1.0, composed)
    return dataclasses.replace(episode, given=said)


ROUTES = (
    given(drive(SLOW, route="a"), "Completed", 100.0),
    given(drive(RAMMED, route="b"), "Completed", 59.9),
    given(
        drive(route="c", completion=30.0, ending=Ending.BLOCKED),
        "Failed - Agent got blocked",
        30.0,
    ),
)


def test_both_quotients_of_what_was_given_and_computed() -> None:
    found = leaderboard_scores(ROUTES)

    for quotients, total in (
        (found.given_score, 189.9),
        (found.score, 190.0),
        (found.success_rate, 100.0),
    ):
        assert quotients.over_set.value == pytest.approx(total / 220)
        assert quotients.over_driven.value == pytest.approx(total / 3)


def test_no_record_has_no_score_and_another_status_is_no_success() -> None:
    odd = given(drive(), "Failed - TickRuntime", 100.0)

    assert leaderboard_scores(()).score.over_set.reason == "there is no record"
    assert leaderboard_scores([odd]).success_rate.over_driven.value == 0.0


TESTED = (
    drive(route="clean", abilities=SIGNS),
    drive(RAN_STOP, route="ran", abilities=SIGNS, completion=90.0),
)


def test_traffic_signs_are_rated_where_no_junction_decides() -> None:
    rates = ability_rates(TESTED)

    assert rates["Traffic_Signs"].value == rates["Merging"].value == 50.0
    # the others were not driven, so there is no mean of five
    assert rates["mean"].measure.reason == "Overtaking: no such route was driven"


def test_where_a_junction_decides_there_is_no_rate() -> None:
    rammed = drive(RAMMED, route="rammed", abilities=SIGNS, completion=80.0)

    rates = ability_rates((*TESTED, rammed))

    signs = rates["Traffic_Signs"].measure
    assert signs.reason == "where the junction is on rammed is not known"
    assert rates["Merging"].value == pytest.approx(100 / 3)


def test_the_mean_is_that_of_five() -> None:
    others = ("Overtaking", "Emergency_Brake", "Give_Way")
    routes = (*TESTED, *(drive(route=each, abilities=(each,)) for each in others))

    mean = ability_rates(routes)["mean"]

    assert mean.value == (100 + 50 + 100 + 100 + 50) / 5
