"""A third evaluator, as another package would bring it: straight lanes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import pytest

from me2e_compress.base.errors import EvaluationError
from me2e_compress.base.listener import Listener
from me2e_compress.driving.contract import RouteInfo
from me2e_compress.driving.latency import DecisionFacts
from me2e_compress.driving.policies import Driver
from me2e_compress.evaluators import EVALUATORS, Drive, Evaluator
from me2e_compress.metrics.episode import Episode, InferenceRecord
from tests.evaluators.highway.asked import observation, planned
from tests.metrics.drives import drive as by_hand
from tests.support.installed import install

DRIVEN: list[tuple[str, str]] = []
"""Policy and lane of every drive."""


@dataclass(frozen=True)
class Lane:
    id: str
    seed: int


@dataclass(frozen=True)
class Lanes(Evaluator):
    """Drives lanes of 24 m, as far as the last waypoint of one plan.

    Attributes:
        count: How many lanes.
        way: In which it errs.
    """

    name: ClassVar[str] = "lanes"
    takes: ClassVar[frozenset[str]] = frozenset(
        {"policy", "adapter", "provider", "routes", "latency"}
    )
    count: int = 4
    way: str = ""

    def routes(
        self, words: str, beside: Path = Path()
    ) -> tuple[Sequence[RouteInfo], int]:
        lanes = [Lane(f"lane_{number}", number) for number in range(self.count)]
        if words.isdecimal():
            return lanes[: int(words)], len(lanes)
        picked = [lane for lane in lanes if words in (lane.id, "all")]
        if not picked:
            raise EvaluationError(f"no lane {words}")
        return picked, len(lanes)

    def episodes(
        self, policy: Driver | None, drive: Drive, folder: Path, listener: Listener
    ) -> Iterator[Episode]:
        assert policy is not None
        opened = policy.open()
        for lane in reversed(drive.routes):
            DRIVEN.append((policy.label, lane.id))
            opened.reset(lane)
            points = planned(opened, observation())
            latency_us = drive.latency.on_route(lane.id)(DecisionFacts(0))
            episode = by_hand(
                route={"twin": "lane_0", "strange": "lane_9"}.get(self.way, lane.id),
                completion=min(100.0, 100.0 * float(points[-1, 0]) / 24.0),
            )
            if self.way != "lost" or lane.seed:
                decisions = (InferenceRecord(0, latency_us),)
                yield replace(episode, decisions=decisions)


@dataclass(frozen=True)
class Tape(Evaluator):
    """Reads how somebody drove, on routes that it alone knows.

    Attributes:
        named: What they are called.
    """

    name: ClassVar[str] = "tape"
    named: tuple[str, ...] = ("a", "b")

    def episodes(
        self, policy: Driver | None, drive: Drive, folder: Path, listener: Listener
    ) -> Iterator[Episode]:
        for name in self.named:
            yield by_hand(route=name, completion=50.0)


def install_lanes(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    entries = {"lanes": f"{__name__}:Lanes", "tape": f"{__name__}:Tape"}
    install(monkeypatch, folder, "lanes", EVALUATORS.group, entries)
    DRIVEN.clear()
