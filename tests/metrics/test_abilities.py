import pytest

from me2e_compress.metrics.bench2drive import mastered, successes
from me2e_compress.metrics.episode import Infraction, InfractionKind
from tests.metrics.drives import drive, infraction

SIGNS = ("Merging", "Traffic_Signs")
CRASH = infraction(InfractionKind.COLLISION_VEHICLE)


def test_a_success_counts_under_every_ability_of_the_route() -> None:
    counted = successes([drive(abilities=SIGNS)])

    assert counted["Merging"] == counted["Traffic_Signs"] == (True,)
    assert counted["Overtaking"] == ()


@pytest.mark.parametrize(("completion", "obeyed"), [(48.0, False), (48.1, True)])
def test_signs_are_mastered_eight_metres_into_the_junction(
    completion: float, obeyed: bool
) -> None:
    crashed_later = drive(
        CRASH, completion=completion, abilities=SIGNS, junction_m=40.0
    )

    assert mastered(crashed_later, "Traffic_Signs") is obeyed
    assert not mastered(crashed_later, "Merging")


@pytest.mark.parametrize(
    ("broken", "junction_m"),
    [
        (infraction(InfractionKind.STOP), 10.0),
        (infraction(InfractionKind.RED_LIGHT), 10.0),
        (CRASH, None),
    ],
)
def test_a_broken_sign_is_not_mastered_nor_without_a_junction_anything_but_success(
    broken: Infraction, junction_m: float | None
) -> None:
    ran_it = drive(broken, abilities=SIGNS, junction_m=junction_m)

    assert not mastered(ran_it, "Traffic_Signs")
