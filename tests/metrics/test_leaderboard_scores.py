import dataclasses

import pytest

from me2e_compress.metrics.abilities import Rules, ability_rates
from me2e_compress.metrics.driving_score import route_score
from me2e_compress.metrics.episode import Ending, Episode, Given
from me2e_compress.metrics.infraction import Infraction, InfractionKind
from me2e_compress.metrics.leaderboard_scores import (
    VERSIONS,
    Version,
    leaderboard_scores,
    score_under,
)
from tests.metrics.drives import drive, infraction

SIGNS = ("Merging", "Traffic_Signs")
RAMMED = infraction(InfractionKind.COLLISION_VEHICLE)
RAN_LIGHT = infraction(InfractionKind.RED_LIGHT)
LEFT_LANE = infraction(InfractionKind.OUTSIDE_ROUTE_LANES, percent=10.0)
FAST = infraction(InfractionKind.MIN_SPEED, percent=250.0)
STUCK_BEHIND = infraction(InfractionKind.SCENARIO_TIMEOUT)
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

    assert found.given_score.over_set.value == pytest.approx(189.9 / 220)
    assert found.given_score.over_driven.value == pytest.approx(189.9 / 3)
    assert found.score.over_set.value == pytest.approx(190.0 / 220)
    assert found.score.over_driven.value == pytest.approx(190.0 / 3)
    assert found.success_rate.over_set.value == pytest.approx(100 / 220)
    assert found.success_rate.over_driven.value == pytest.approx(100 / 3)
    assert found.score == found.score_without_low_speed


def test_low_speed_stands_apart_where_it_costs() -> None:
    found = leaderboard_scores(ROUTES, "2.0")

    assert found.score.over_driven.value == pytest.approx((85 + 60 + 30) / 3)
    assert found.score_without_low_speed.over_driven.value == pytest.approx(190 / 3)


def test_no_record_has_no_score() -> None:
    assert leaderboard_scores(()).score.over_set.reason == "there is no record"


def test_a_completed_route_with_another_status_is_no_success() -> None:
    odd = given(drive(), "Failed - TickRuntime", 100.0)

    assert leaderboard_scores([odd]).success_rate.over_driven.value == 0.0


TESTED = (
    drive(route="clean", abilities=SIGNS),  # S, J
    drive(RAMMED, route="rammed", abilities=SIGNS, completion=80.0),  # J alone
    drive(RAN_STOP, route="ran", abilities=SIGNS, completion=90.0),  # neither
    drive(RAMMED, route="early", abilities=SIGNS, completion=40.0),  # neither
)
JUNCTIONS = {"clean": 0.5, "rammed": 0.79, "early": 0.4}


@pytest.mark.parametrize(
    ("rules", "percent"), [("0.0.3", 100 * 3 / 8), ("0.0.4", 100 * 2 / 4)]
)
def test_traffic_signs_by_two_sets_of_rules(rules: Rules, percent: float) -> None:
    rates = ability_rates(TESTED, rules, JUNCTIONS)

    assert rates["Traffic_Signs"].value == percent
    assert rates["Merging"].value == 25.0
    # the others were not driven, so there is no mean of five
    assert rates["mean"].measure.reason == "Overtaking: no such route was driven"


@pytest.mark.parametrize(("rules", "known"), [("0.0.3", False), ("0.0.4", True)])
def test_where_a_junction_decides_it_must_be_known(rules: Rules, known: bool) -> None:
    without = {"rammed": 0.79, "early": 0.4}

    signs = ability_rates(TESTED, rules, without)["Traffic_Signs"]

    assert (signs.value is not None) is known
    if not known:
        assert signs.measure.reason == "where the junction is on clean is not known"


def test_the_mean_is_that_of_five() -> None:
    others = ("Overtaking", "Emergency_Brake", "Give_Way")
    routes = (*TESTED, *(drive(route=each, abilities=(each,)) for each in others))

    mean = ability_rates(routes, "0.0.4", JUNCTIONS)["mean"]

    assert mean.value == (100 + 25 + 100 + 100 + 50) / 5


@pytest.mark.parametrize(
    ("version", "penalty"),
    [
        ("b2d", 0.9 * 0.6 * 0.7),
        ("1.0", 0.9 * 0.6 * 0.7),
        ("2.0", 0.9 * 0.6 * 0.7 * 0.85),
        ("2.1", 0.9 / (1 + 0.7 + 0.4 + 0.2)),
    ],
)
def test_one_route_under_four_sets_of_rules(version: Version, penalty: float) -> None:
    route = drive(RAMMED, RAN_LIGHT, LEFT_LANE, SLOW, FAST, completion=80.0)

    found = score_under(route, version)

    assert found.penalty == round(penalty, 6)
    assert found.composed == round(80.0 * penalty, 6)


@pytest.mark.parametrize(
    ("version", "penalty"), [("b2d", 0.7), ("1.0", 1.0), ("2.0", 0.7), ("2.1", 1 / 1.4)]
)
def test_the_first_leaderboard_knows_no_scenario_timeouts(
    version: Version, penalty: float
) -> None:
    assert score_under(drive(STUCK_BEHIND), version).penalty == round(penalty, 6)


@pytest.mark.parametrize("kind", InfractionKind)
def test_bench2drives_rules_are_those_of_the_driving_score(
    kind: InfractionKind,
) -> None:
    route = drive(Infraction(kind, None, None, None, "", 30.0), completion=70.0)

    assert score_under(route, "b2d") == route_score(route)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_clean_route_costs_nothing(version: Version) -> None:
    assert score_under(drive(FAST), version).composed == 100.0


def test_more_outside_than_driven_leaves_nothing() -> None:
    astray = infraction(InfractionKind.OUTSIDE_ROUTE_LANES, percent=140.0)

    assert score_under(drive(astray), "b2d").composed == 0.0
