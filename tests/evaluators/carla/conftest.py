import sys
from collections.abc import Iterator

import pytest

from tests.evaluators.carla.small_leaderboard import Leaderboard, installed


@pytest.fixture
def board(monkeypatch: pytest.MonkeyPatch) -> Leaderboard:
    return installed(monkeypatch)


@pytest.fixture(autouse=True)
def fresh(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The wrapped agent's module sees the leaderboard of its own test."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield
    for name in [name for name in sys.modules if name.endswith("_agent")]:
        if "." not in name:
            del sys.modules[name]
