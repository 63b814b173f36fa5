import pytest

from me2e_compress.metrics.abilities import mastered, successes
from me2e_compress.metrics.infraction import InfractionKind
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


@pytest.mark.parametrize("kind", [InfractionKind.STOP, InfractionKind.RED_LIGHT])
def test_a_broken_sign_is_not_mastered(kind: InfractionKind) -> None:
    ran_it = drive(infraction(kind), abilities=SIGNS, junction_m=10.0)

    assert not mastered(ran_it, "Traffic_Signs")


def test_without_a_junction_only_success_counts() -> None:
    assert not mastered(drive(CRASH, abilities=SIGNS), "Traffic_Signs")
