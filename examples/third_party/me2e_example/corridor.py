"""The smallest evaluator: a straight corridor, in which the plan is followed."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from me2e_compress.base.errors import EvaluationError
from me2e_compress.base.listener import Listener
from me2e_compress.driving.contract import (
    CAN_BUS_SIZE,
    Observation,
    RouteInfo,
    six_waypoints,
)
from me2e_compress.driving.latency import DecisionFacts
from me2e_compress.driving.policies import Driver
from me2e_compress.evaluators import Drive, Evaluator
from me2e_compress.metrics.episode import (
    FRAME_US,
    EgoFrame,
    Ending,
    Episode,
    InferenceRecord,
)

LENGTH_M = 60.0
LIMIT_S = 30.0


@dataclass(frozen=True)
class Lane:
    """A route is a name and a seed here."""

    id: str
    seed: int


@dataclass(frozen=True)
class Corridor(Evaluator):
    """Drives a policy along straight corridors of 60 m.

    Attributes:
        count: how many corridors.
    """

    name: ClassVar[str] = "corridor"
    takes: ClassVar[frozenset[str]] = frozenset({"policy", "routes", "latency"})
    count: int = 2

    def routes(self, words: str, beside: Path = Path()) -> tuple[tuple[Lane, ...], int]:
        """Return all corridors, or the first of them by a number."""
        lanes = tuple(Lane(f"corridor_{n}", n) for n in range(self.count))
        return lanes if words == "all" else lanes[: int(words)], self.count

    def episodes(
        self, policy: Driver | None, drive: Drive, folder: Path, listener: Listener
    ) -> Iterator[Episode]:
        """Yield each corridor once, in order."""
        assert policy is not None
        for lane in drive.routes:
            yield self._drive(lane, policy, drive)

    def check_policy(self, policy: Driver) -> None:
        """Refuse what needs images, or knows more than its observations."""
        opened = policy.open()
        if opened.needs_images or opened.privileged:
            raise EvaluationError(f"{policy.label}: corridors have no images or scenes")

    def _drive(self, lane: RouteInfo, driver: Driver, drive: Drive) -> Episode:
        policy, charge = driver.open(), drive.latency.on_route(lane.id)
        policy.reset(lane)
        x, frames, decisions = 0.0, list[EgoFrame](), list[InferenceRecord]()
        while x < LENGTH_M and len(frames) * FRAME_US < LIMIT_S * 1e6:
            time_us = len(frames) * FRAME_US
            waypoints = six_waypoints(policy.plan(_seen(time_us)))
            speed_mps = float(waypoints[0, 0]) / 0.5
            decisions.append(InferenceRecord(time_us, charge(DecisionFacts(0))))
            frames.append(_frame(time_us, x, speed_mps))
            x += speed_mps * FRAME_US / 1e6
        done = x >= LENGTH_M
        return Episode(
            route=lane.id,
            scenario="Corridor",
            abilities=(),
            route_length_m=LENGTH_M,
            completion_percent=100.0 if done else 100.0 * x / LENGTH_M,
            ending=Ending.COMPLETED if done else Ending.TIMEOUT,
            failure=None,
            infractions=(),
            frames=tuple(frames),
            decisions=tuple(decisions),
        )


def _seen(time_us: int) -> Observation:
    return Observation(
        time_us=time_us,
        images=None,
        lidar2img=np.tile(np.eye(4, dtype=np.float32), (6, 1, 1)),
        can_bus=np.zeros(CAN_BUS_SIZE, np.float32),
        command=3,
        speed_mps=0.0,
    )


def _frame(time_us: int, x: float, speed_mps: float) -> EgoFrame:
    return EgoFrame(
        time_us=time_us,
        x=x,
        y=0.0,
        heading=0.0,
        speed_mps=speed_mps,
        acceleration_mps2=0.0,
        lateral_acceleration_mps2=0.0,
        yaw_rate_radps=0.0,
        steering_rad=0.0,
        route_m=x,
        traffic_speed_mps=None,
    )
