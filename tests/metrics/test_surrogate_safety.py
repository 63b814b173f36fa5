import dataclasses
import math
from collections.abc import Callable

import pytest

from me2e_compress.metrics.episode import (
    ConflictRecord,
    Encounter,
    Episode,
    Infraction,
    InfractionKind,
)
from me2e_compress.metrics.measure import Measure
from me2e_compress.metrics.route_scores import (
    at_fault_collision,
    room_kept,
    smallest_distance,
    smallest_pet,
    smallest_ttc,
    ttc_exposure,
)
from me2e_compress.metrics.route_summary import RouteSummary
from me2e_compress.metrics.scores import score
from tests.metrics.drives import drive, infraction


def encounter(pet_s: float, angle_deg: float) -> Encounter:
    return Encounter(1, "car", 0, pet_s, math.radians(angle_deg), ego_first=True)


def crash(at_fault: bool | None) -> Infraction:
    found = infraction(InfractionKind.COLLISION_VEHICLE)
    return dataclasses.replace(found, at_fault=at_fault)


NEAR_MISS = drive(
    conflicts=ConflictRecord(
        nearest_m=(9.0, 3.5, None, 4.0),
        ttc_s=(None, 1.5, 1.49, 0.8),
        encounters=(encounter(0.4, 29.0), encounter(2.5, 90.0), encounter(3.0, 31.0)),
    )
)
ALONE = drive(conflicts=ConflictRecord((None,), (None,), ()))


def test_two_of_four_frames_were_a_conflict_and_the_smallest_of_a_route() -> None:
    assert ttc_exposure(NEAR_MISS) == Measure(50.0, "%")
    assert ttc_exposure(ALONE) == Measure(0.0, "%")
    assert smallest_ttc(NEAR_MISS) == Measure(0.8, "s")
    assert smallest_distance(NEAR_MISS) == Measure(3.5, "m")
    assert smallest_pet(NEAR_MISS) == Measure(2.5, "s")
    assert smallest_ttc(ALONE).reason == "no contact was ever within 10 s"
    assert smallest_distance(ALONE).reason == "nobody else was there"
    assert smallest_pet(ALONE).reason == "no paths crossed within 5 s"


def test_room_is_kept_by_who_comes_near_nobody() -> None:
    assert NEAR_MISS.conflicts is not None
    close = dataclasses.replace(
        NEAR_MISS.conflicts, encounters=(encounter(0.3, 60.0), encounter(2.0, 90.0))
    )
    found = [
        room_kept(drive(*faults, conflicts=conflicts)).value
        for faults, conflicts in (
            ((), NEAR_MISS.conflicts),
            ((), close),
            ((crash(False),), close),
            ((crash(True),), close),
            ((), ALONE.conflicts),
        )
    ]

    assert found == pytest.approx([50.0, 10.0, 10.0, 0.0, 100.0])
    for faults in ((), (crash(True),), (crash(None),)):
        episode = drive(*faults, conflicts=close)
        assert RouteSummary.of(episode).room_kept == room_kept(episode).value
    unknown = room_kept(drive(crash(None), conflicts=close))
    assert unknown == Measure(None, "%", "whose fault a collision was is not known")


@pytest.mark.parametrize(
    "measure", [room_kept, ttc_exposure, smallest_ttc, smallest_distance, smallest_pet]
)
def test_what_was_not_recorded_is_not_measured(
    measure: Callable[[Episode], Measure],
) -> None:
    assert measure(drive()).reason == "nobody recorded the distances to others"


@pytest.mark.parametrize(
    ("faults", "answer"),
    [((), False), ((False,), False), ((None,), None), ((None, True), True)],
)
def test_whether_a_collision_was_the_egos_fault(
    faults: tuple[bool | None, ...], answer: bool | None
) -> None:
    assert at_fault_collision(drive(*map(crash, faults))) is answer


def test_the_rate_of_collisions_at_fault_and_none_of_one_unknown_fault() -> None:
    found = score([drive(), drive(crash(False)), drive(crash(True)), drive()]).safety
    unknown = score([drive(), drive(crash(None))]).safety

    assert found.at_fault_collisions.value == 25.0
    assert found.at_fault_collisions.n == 4
    reason = "whose fault 1 collisions were is not known"
    assert unknown.at_fault_collisions.measure == Measure(None, "%", reason)
