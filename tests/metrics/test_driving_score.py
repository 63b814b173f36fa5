import math

import pytest

from me2e_compress.metrics.episode import PENALTY, Ending, InfractionKind
from me2e_compress.metrics.route_scores import RouteScore, route_score
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
    scored = route_score(drive(infraction(kind), completion=80.0))

    assert scored == RouteScore(
        80.0, FACTORS[kind.value], round(80 * FACTORS[kind.value], 6)
    )


def test_leaving_the_lanes_costs_its_share_of_the_way() -> None:
    outside = infraction(InfractionKind.OUTSIDE_ROUTE_LANES, percent=12.5)

    assert route_score(drive(outside)).composed == 87.5


def test_penalties_multiply_and_are_rounded_to_six_digits() -> None:
    three = [infraction(InfractionKind.COLLISION_LAYOUT) for _ in range(3)]

    scored = route_score(drive(*three, completion=33.33))

    assert scored.penalty == 0.274625
    assert scored.composed == round(33.33 * 0.65**3, 6)


def test_a_clean_route_scores_its_completion() -> None:
    assert route_score(drive(completion=61.5)) == RouteScore(61.5, 1.0, 61.5)


@pytest.mark.parametrize("kind", InfractionKind)
def test_any_infraction_but_a_low_speed_spoils_success(kind: InfractionKind) -> None:
    percent = 0.1 if kind is InfractionKind.OUTSIDE_ROUTE_LANES else None
    succeeded = drive(infraction(kind, percent)).succeeded

    assert succeeded == (kind is InfractionKind.MIN_SPEED)


def test_an_unfinished_route_is_no_success() -> None:
    assert not drive(completion=math.nextafter(100.0, 0.0)).succeeded


@pytest.mark.parametrize("ending", [e for e in Ending if e is not Ending.COMPLETED])
def test_a_whole_route_that_ended_otherwise_is_no_success(ending: Ending) -> None:
    assert not drive(ending=ending).succeeded
