import pytest

from me2e_compress.metrics.driving_score import route_score
from me2e_compress.metrics.infraction import Infraction, InfractionKind
from me2e_compress.metrics.penalties import VERSIONS, Version, score_under
from tests.metrics.drives import drive, infraction

RAMMED = infraction(InfractionKind.COLLISION_VEHICLE)
RAN_LIGHT = infraction(InfractionKind.RED_LIGHT)
LEFT_LANE = infraction(InfractionKind.OUTSIDE_ROUTE_LANES, percent=10.0)
HALF_SPEED = infraction(InfractionKind.MIN_SPEED, percent=50.0)
FAST = infraction(InfractionKind.MIN_SPEED, percent=250.0)
STUCK_BEHIND = infraction(InfractionKind.SCENARIO_TIMEOUT)


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
    route = drive(RAMMED, RAN_LIGHT, LEFT_LANE, HALF_SPEED, FAST, completion=80.0)

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
