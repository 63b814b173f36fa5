"""The routes of a trial: found once, and gone on with after a kill."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from me2e_compress.base.errors import EvaluationError
from me2e_compress.evaluators.highway.driven_frames import propose
from me2e_compress.simulator.routes import Route, load_routes
from models.driver import admission as gate
from models.driver import trial
from models.driver.admission import ScenarioRoutes
from models.driver.curriculum import Trial
from models.driver.errors import TrainingError

TYPES = ("ControlLoss", "HighwayCutIn")
WHAT = Trial(seed=7, routes=3, scenarios=TYPES)


class Gate:
    """Admits every first proposal, and dies before a type."""

    def __init__(self, dies_before: str = "") -> None:
        self.asked, self.dies_before = list[str](), dies_before

    def __call__(
        self, seed: int, types: Sequence[str], variants: int, workers: int
    ) -> Iterator[ScenarioRoutes]:
        for name in types:
            if name == self.dies_before:
                raise KeyboardInterrupt
            self.asked.append(name)
            routes = [
                propose(name, seed + number, f"{name}_{number}")
                for number in range(variants)
            ]
            yield ScenarioRoutes(name, tuple(routes), ())


def found(path: Path) -> tuple[Route, ...]:
    return trial.routes_of(WHAT, path, 1, lambda done, total: None)


def test_a_search_that_was_killed_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "trial.json"
    monkeypatch.setattr(gate, "generate", Gate(TYPES[1]))
    with pytest.raises(KeyboardInterrupt):
        found(path)
    monkeypatch.setattr(gate, "generate", second := Gate())
    with pytest.raises(EvaluationError, match="begun with seed 7, not 8; delete it"):
        gate.make_routes(path, 8, TYPES, 2)
    routes = found(path)
    assert second.asked == [TYPES[1]]
    assert [each.scenario for each in routes] == [TYPES[0], TYPES[0], TYPES[1]]
    monkeypatch.setattr(gate, "generate", None)  # nobody is asked again
    assert found(path) == routes
    assert [each.name for each in tmp_path.iterdir()] == ["trial.json"]


def test_routes_that_ship_are_not_tried_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = next(each for each in load_routes() if each.scenario == TYPES[0])
    routes = ScenarioRoutes(TYPES[0], (shipped,), ())
    monkeypatch.setattr(gate, "generate", lambda *_: iter([routes]))
    what = Trial(seed=7, routes=1, scenarios=TYPES[:1])
    with pytest.raises(TrainingError, match=f"route {shipped.id}, which is for eval"):
        trial.routes_of(what, tmp_path / "trial.json", 1, lambda done, total: None)
