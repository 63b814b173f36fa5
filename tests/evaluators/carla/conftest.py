import pytest

from tests.evaluators.carla.small_leaderboard import Leaderboard, installed


@pytest.fixture
def board(monkeypatch: pytest.MonkeyPatch) -> Leaderboard:
    return installed(monkeypatch)
