"""Costly fixtures are made once."""

import pytest


@pytest.mark.xdist_group("groups")
def test_the_group_of_a_test_is_known(request: pytest.FixtureRequest) -> None:
    """Or else each process makes every costly fixture anew, and nobody is told."""
    if not getattr(request.config.option, "loadgroup", False):
        pytest.skip("processes do not group tests here")

    assert request.node.nodeid.endswith("@groups")
