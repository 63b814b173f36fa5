"""Property tests draw what the profile says; costly fixtures are made once."""

import pytest
from hypothesis import settings

from tests.profiles import scaled


def test_ci_draws_the_same_every_time_and_night_more(
    pytestconfig: pytest.Config,
) -> None:
    profile = settings.get_profile(str(pytestconfig.getoption("--hypothesis-profile")))
    ci, night = settings.get_profile("ci"), settings.get_profile("night")

    assert (ci.derandomize, ci.max_examples) == (True, 100)
    assert (night.derandomize, night.max_examples) == (False, 1000)
    assert settings().derandomize == profile.derandomize
    assert settings().max_examples == profile.max_examples == scaled(25) * 4
    assert settings().deadline is None


@pytest.mark.xdist_group("groups")
def test_the_group_of_a_test_is_known(request: pytest.FixtureRequest) -> None:
    """Or else each process makes every costly fixture anew, and nobody is told."""
    if not getattr(request.config.option, "loadgroup", False):
        pytest.skip("processes do not group tests here")

    assert request.node.nodeid.endswith("@groups")
