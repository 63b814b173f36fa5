"""The small leaderboard, and the agent that sees it."""

import importlib
import sys
from types import ModuleType

import pytest

from small_leaderboard import Leaderboard, modules

AGENT = "bench2drive_agent.graph_agent"


@pytest.fixture
def board(monkeypatch: pytest.MonkeyPatch) -> Leaderboard:
    found = Leaderboard()
    for name, module in modules(found).items():
        monkeypatch.setitem(sys.modules, name, module)
    return found


@pytest.fixture
def graph_agent(board: Leaderboard, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The module, as if imported by this leaderboard."""
    monkeypatch.delitem(sys.modules, AGENT, raising=False)
    found = importlib.import_module(AGENT)
    monkeypatch.setitem(sys.modules, AGENT, found)
    return found
