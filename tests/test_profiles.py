"""Property tests draw what the profile says that was asked for."""

import pytest
from hypothesis import settings

from tests.profiles import scaled


def test_the_profile_that_was_asked_for_holds(pytestconfig: pytest.Config) -> None:
    asked = settings.get_profile(str(pytestconfig.getoption("--hypothesis-profile")))

    assert settings().derandomize == asked.derandomize
    assert settings().max_examples == asked.max_examples
    assert settings().deadline is None


def test_ci_draws_the_same_every_time_and_night_more() -> None:
    ci, night = settings.get_profile("ci"), settings.get_profile("night")

    assert (ci.derandomize, ci.max_examples) == (True, 100)
    assert (night.derandomize, night.max_examples) == (False, 1000)


def test_dear_examples_are_fewer_and_as_many_times_more_by_night() -> None:
    assert scaled(25) * 4 == settings().max_examples
