import dataclasses
import math

import pytest

from me2e_compress.metrics.bench2drive import mastered
from me2e_compress.metrics.episode import (
    PENALTY,
    Ending,
    Episode,
    Given,
    InfractionKind,
)
from me2e_compress.metrics.route_scores import RouteScore, route_score
from me2e_compress.metrics.scores import Quotients, leaderboard_scores, score
from tests.metrics.drives import drive, infraction

# Bench2Drive, statistics_manager.py; give way is ours.
FACTORS = {
    "collisions_pedestrian": 0.5,
    "collisions_vehicle": 0.6,
    "collisions_layout": 0.65,
    "red_light": 0.7,
    "stop_infraction": 0.8,
    "give_way_infraction": 0.8,
    "scenario_timeouts": 0.7,
    "yield_emergency_vehicle_infractions": 0.7,
    "min_speed_infractions": 1.0,
    "route_dev": 1.0,
    "vehicle_blocked": 1.0,
    "route_timeout": 1.0,
}


@pytest.mark.parametrize("kind", PENALTY)
def test_each_infraction_costs_its_factor(kind: InfractionKind) -> None:
    factor = FACTORS[kind]

    scored = route_score(drive(infraction(kind), completion=80.0))

    assert scored == RouteScore(80.0, factor, round(80 * factor, 6))


def test_penalties_multiply_and_leaving_the_lanes_costs_its_share_of_the_way() -> None:
    three = [infraction(InfractionKind.COLLISION_LAYOUT) for _ in range(3)]
    outside = infraction(InfractionKind.OUTSIDE_ROUTE_LANES, percent=12.5)

    scored = route_score(drive(*three, completion=33.33))

    assert scored.penalty == 0.274625
    assert scored.composed == round(33.33 * 0.65**3, 6)
    assert route_score(drive(outside)).composed == 87.5


@pytest.mark.parametrize("kind", InfractionKind)
def test_any_infraction_but_a_low_speed_spoils_success(kind: InfractionKind) -> None:
    percent = 0.1 if kind is InfractionKind.OUTSIDE_ROUTE_LANES else None
    succeeded = drive(infraction(kind, percent)).succeeded

    assert succeeded == (kind is InfractionKind.MIN_SPEED)


@pytest.mark.parametrize("ending", [e for e in Ending if e is not Ending.COMPLETED])
def test_a_route_unfinished_or_ended_otherwise_is_no_success(ending: Ending) -> None:
    assert not drive(ending=ending).succeeded
    assert not drive(completion=math.nextafter(100.0, 0.0)).succeeded


SIGNS = ("Merging", "Traffic_Signs")
CRASH = infraction(InfractionKind.COLLISION_VEHICLE)


@pytest.mark.parametrize(("completion", "obeyed"), [(48.0, False), (48.1, True)])
def test_signs_are_mastered_eight_metres_into_the_junction(
    completion: float, obeyed: bool
) -> None:
    crashed_later = drive(
        CRASH, completion=completion, abilities=SIGNS, junction_m=40.0
    )

    assert mastered(crashed_later, "Traffic_Signs") is obeyed
    assert not mastered(crashed_later, "Merging")


def test_a_broken_sign_is_not_mastered_nor_any_without_a_junction() -> None:
    for kind in (InfractionKind.STOP, InfractionKind.RED_LIGHT):
        ran_it = drive(infraction(kind), abilities=SIGNS, junction_m=10.0)
        assert not mastered(ran_it, "Traffic_Signs")
    assert not mastered(drive(CRASH, abilities=SIGNS), "Traffic_Signs")


RAN_STOP = infraction(InfractionKind.STOP)


def given(episode: Episode, status: str, composed: float) -> Episode:
    scores = Given(status, episode.completion_percent, 1.0, composed)
    return dataclasses.replace(episode, given=scores)


def test_no_record_has_no_score_and_another_status_is_no_success() -> None:
    odd = given(drive(), "Failed - TickRuntime", 100.0)

    assert leaderboard_scores(()).computed["driving_score"] == Quotients()
    assert leaderboard_scores([odd]).computed["success_rate"].driven == 0.0


TESTED = (
    drive(route="clean", abilities=SIGNS),
    drive(RAN_STOP, route="ran", abilities=SIGNS, completion=90.0),
)


def test_traffic_signs_are_rated_unless_a_junction_decides() -> None:
    scores = score(TESTED)

    rates = scores.each_ability
    assert rates["Traffic_Signs"].value == rates["Merging"].value == 50.0
    # the others were not driven, so there is no mean of five
    assert scores.abilities.value is None


def test_a_real_run_does_not_say_where_its_junctions_are() -> None:
    rammed = drive(CRASH, route="rammed", abilities=SIGNS, completion=80.0)

    rates = score((*TESTED, given(rammed, "Completed", 48.0))).each_ability

    signs = rates["Traffic_Signs"].measure
    assert signs.reason == "where the junction is on rammed is not known"
    assert rates["Merging"].value == pytest.approx(100 / 3)


def test_the_mean_is_that_of_five() -> None:
    others = ("Overtaking", "Emergency_Brake", "Give_Way")
    routes = (*TESTED, *(drive(route=other, abilities=(other,)) for other in others))

    assert score(routes).abilities.value == (100 + 50 + 100 + 100 + 50) / 5
