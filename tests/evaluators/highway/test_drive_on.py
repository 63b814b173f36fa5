"""Driving on after a collision, scored by both rules from one drive."""

from dataclasses import replace

import numpy as np
import pytest

from me2e_compress.evaluators import Drive
from me2e_compress.evaluators.highway.blind import Blind
from me2e_compress.evaluators.highway.runner import drive
from me2e_compress.metrics.episode import COLLISIONS, Ending, Episode
from me2e_compress.metrics.route_scores import route_score, score_to_first_collision
from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.traffic.bodies import Contacts, EgoVehicle, depth
from me2e_compress.simulator.traffic.network import Pose
from tests.evaluators.highway.evaluations import made_by
from tests.simulator.world.driving import route_of

ON = Drive(drive_on=True)


def both(route: Route, speed_mps: float) -> tuple[Episode, Episode]:
    ended = drive(route, Blind(speed_mps), Drive())
    return ended, drive(route, Blind(speed_mps), ON)


@pytest.fixture(scope="module")
def drives() -> tuple[Episode, Episode]:
    return both(route_of("HighwayCutIn", 5), 12.0)


def test_one_drive_is_scored_by_both_rules(drives: tuple[Episode, Episode]) -> None:
    ended, went_on = drives

    assert ended.ending is Ending.COLLISION
    assert ended.first_collision is None
    assert went_on.ending is not Ending.COLLISION
    assert score_to_first_collision(went_on) == route_score(ended)
    assert score_to_first_collision(ended) == route_score(ended)
    assert went_on.frames[: len(ended.frames) - 1] == ended.frames[:-1]


def test_the_first_collision_is_judged_as_it_was(
    drives: tuple[Episode, Episode],
) -> None:
    first, again = (
        next(each for each in one.infractions if each.kind in COLLISIONS)
        for one in drives
    )

    assert first == again
    assert first.contact is not None


def test_every_collision_multiplies_and_the_route_goes_on(
    drives: tuple[Episode, Episode],
) -> None:
    ended, went_on = drives
    factors = [each.factor for each in went_on.infractions]

    assert route_score(went_on).penalty == pytest.approx(np.prod(factors), abs=1e-6)
    assert len(went_on.frames) > len(ended.frames)
    assert went_on.completion_percent >= ended.completion_percent
    assert not went_on.succeeded


def test_it_is_written_only_of_drives_that_went_on(
    drives: tuple[Episode, Episode],
) -> None:
    ended, went_on = drives

    assert "first_collision" not in ended.to_json()
    assert Episode.from_json(went_on.to_json()) == went_on
    assert Episode.from_json(ended.to_json()) == ended


def test_the_option_is_a_condition_of_the_results() -> None:
    plain, went_on = made_by(drive=Drive()), made_by(drive=ON)

    assert {**plain, "drive_on": True} == went_on
    assert Drive.of_words(drive_on=True) == ON


def ego(x: float, heading: float = 0.0) -> EgoVehicle:
    return EgoVehicle(Pose(x, 0.0, heading), 5.0)


def test_the_ego_does_not_move_farther_into_a_body_and_may_leave_it() -> None:
    mine, other, contacts = ego(0.2), ego(5.0), Contacts()
    contacts.before(mine)
    mine.position = mine.position + np.array((0.4, 0.0))
    contacts.resist(mine, other)
    assert (float(mine.position[0]), mine.speed) == (0.2, 0.0)

    mine.speed = 5.0
    contacts.before(mine)
    mine.position = mine.position - np.array((0.1, 0.0))
    contacts.resist(mine, other)
    assert mine.speed == 5.0
    assert depth(mine.position, mine.heading, mine, other) == pytest.approx(0.1)


def test_who_scrapes_along_a_body_gets_by() -> None:
    mine, other, contacts = ego(0.0), ego(3.0), Contacts()
    other.position = other.position + np.array((0.0, 1.9))
    contacts.before(mine)
    mine.position = mine.position + np.array((0.5, 0.0))
    contacts.resist(mine, other)

    assert mine.speed == 5.0


def test_contacts_soon_after_or_near_are_no_other_collision() -> None:
    mine, contacts = ego(0.0), Contacts()
    far = [replace(mine.pose, x=x).x for x in (0.0, 20.0, 40.0)]
    counted = list[bool]()
    for time_s, x, body in (
        (0, far[0], 1),
        (3, far[1], 1),
        (9, far[1], 1),
        (10, far[1] + 3.0, 2),
        (11, far[2], 3),
    ):
        mine.position = np.array([x, 0.0])
        counted.append(contacts.counts(time_s * 1_000_000, mine, body))

    assert counted == [True, False, True, False, True]
