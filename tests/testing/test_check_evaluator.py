import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest

from me2e_compress.base.errors import VerificationError
from me2e_compress.base.listener import Listener
from me2e_compress.driving.policies import Driver
from me2e_compress.evaluators import Drive, Evaluator
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.evaluators.highway.evaluator import Highway
from me2e_compress.metrics.episode import Episode
from me2e_compress.simulator.routes import save_routes
from me2e_compress.testing import check_evaluator
from models.driver.expert.blind import BlindDriver
from tests.evaluators.highway.drivers import EXIT, straight_on
from tests.evaluators.lanes import Lanes
from tests.metrics.drives import drive as by_hand
from tests.metrics.drives import frames

RUNS = itertools.count()
STUTTER = (*frames(2), *frames(2))


@dataclass(frozen=True)
class Made(Evaluator):
    """Yields episodes made by hand.

    Attributes:
        way: In which it errs.
    """

    name: ClassVar[str] = "made"
    way: str = ""

    def episodes(
        self, policy: Driver | None, drive: Drive, folder: Path, listener: Listener
    ) -> Iterator[Episode]:
        run = next(RUNS)
        routes = {"none": [], "twice": ["a", "b", "a"]}.get(self.way, ["a", "b"])
        if self.way == "no name":
            routes = ["../a"]
        if self.way == "order" and run % 2:
            routes = routes[::-1]
        for route in routes:
            if self.way == "no episode":
                yield route  # type: ignore[misc]
            moved = float(run) if self.way == "drifts" else 100.0
            moved = 140.0 if self.way == "too far" else moved
            driven = STUTTER if self.way == "stutters" else ()
            yield by_hand(route=route, completion=moved, driven=driven)


def test_what_errs_in_no_way_holds() -> None:
    assert [each.route for each in check_evaluator(Made())] == ["a", "b"]


@dataclass(frozen=True)
class Sized(Made):
    """Its size is a method."""

    def set_size(self) -> int:  # type: ignore[override]
        return 2


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (Made("none"), "made yields no episode"),
        (Made("no episode"), "made yields 'a', no episode"),
        (Made("twice"), "made yields route a 2 times"),
        (Made("order"), "made yields other routes, or in another order"),
        (Made("drifts"), "two runs of made give different episodes for a"),
        (Made("no name"), r"made yields route '\.\./a': a name is made of letters"),
        (Made("too far"), "made: a cannot be kept: .* completion_percent Input should"),
        (Made("stutters"), "made: the frames of a are not in their order"),
        (Sized(), "made: set_size is no property"),
    ],
)
def test_a_wrong_evaluator_is_caught(wrong: Made, message: str) -> None:
    with pytest.raises(VerificationError, match=message):
        check_evaluator(wrong)


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ("latency", "made declares latency, and does not"),
        ("render", "declares render, but has no render"),
    ],
)
def test_what_is_declared_must_be_there(
    part: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Made, "takes", frozenset({part}))
    with pytest.raises(VerificationError, match=message):
        check_evaluator(Made())


def test_ours_holds(tmp_path: Path) -> None:
    save_routes([EXIT], tmp_path / "routes.json")

    (episode,) = check_evaluator(
        Highway(), BlindDriver(), str(tmp_path / "routes.json")
    )

    assert episode.route == "exit"
    driver = OnnxDriver(straight_on(tmp_path / "m.onnx"))
    assert len(check_evaluator(Lanes(), driver)) == 4
