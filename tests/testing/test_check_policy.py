import itertools
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import numpy.typing as npt
import pytest

from me2e_compress.base.errors import VerificationError
from me2e_compress.driving.contract import (
    Answer,
    Observation,
    PedalsAndWheel,
    Policy,
    RouteInfo,
    Trajectory,
)
from me2e_compress.driving.policies import Driver
from me2e_compress.simulator.scene import Control
from me2e_compress.simulator.world import World
from me2e_compress.testing import check_policy
from models.driver.expert.blind import BlindDriver

DENSE = np.array([0.1, 0.2])
AHEAD = np.array([[2.0 * k, 0.0] for k in range(1, 7)])


def test_a_privileged_policy_holds() -> None:
    assert len(check_policy(BlindDriver(6.0))) == 8


def points(answer: Trajectory | PedalsAndWheel) -> npt.NDArray[np.floating]:
    assert isinstance(answer, Trajectory)
    return answer.points


@dataclass
class Wrong:
    """Drives ahead, and errs in one way."""

    way: str
    opened: int
    needs_images: bool = False
    privileged: bool = False
    asked: int = field(default=0, init=False)

    def reset(self, route: RouteInfo) -> None:
        if self.way != "remembers":
            self.asked = 0

    def plan(self, observation: Observation) -> Answer:
        self.asked += 1
        answers: dict[str, Answer] = {
            "steers too far": PedalsAndWheel(0.0, 1.3, 0.0),
            "steers": PedalsAndWheel(0.3, 0.0, 0.0),
            "dense": Trajectory(np.array([[0.8, 0.0], [1.6, 0.0]]), DENSE),
            "shape": AHEAD[:5],
            "not finite": np.where(AHEAD > 5, np.inf, AHEAD),
        }
        if self.way == "no time":
            return Trajectory(AHEAD, np.zeros(6))
        if self.way in answers:
            return answers[self.way]
        if self.way == "raises":
            raise KeyError("lost")
        if self.way == "steps" and isinstance(observation.world, World):
            observation.world.step(Control(0.0, 0.0))
        grows = {"remembers": self.asked, "opened": self.opened}
        return AHEAD * grows.get(self.way, 1)


OPENED = itertools.count(1)


@dataclass(frozen=True)
class WrongDriver(Driver):
    """Opens the above.

    Attributes:
        way: In which it errs.
    """

    name: ClassVar[str] = "wrong"
    way: str = ""

    def open(self) -> Policy:
        return Wrong(self.way, next(OPENED), privileged=self.way == "steps")

    def fingerprint(self) -> str:
        return str(next(OPENED)) if self.way == "fingerprint" else super().fingerprint()


@pytest.mark.parametrize(
    ("way", "kind"), [("dense", Trajectory), ("steers", PedalsAndWheel)]
)
def test_other_waypoints_and_controls_hold(way: str, kind: type) -> None:
    assert isinstance(check_policy(WrongDriver(way))[0], kind)


def test_what_errs_in_no_way_holds() -> None:
    assert np.array_equal(points(check_policy(WrongDriver())[0]), AHEAD)


@pytest.mark.parametrize(
    ("way", "message"),
    [
        ("shape", r"wrong: the plan has shape \[5, 2\], it must be \[6, 2\]"),
        ("not finite", "wrong: the plan is not finite"),
        ("steers too far", r"wrong: steer is 1.3, it must be from -1 to 1"),
        ("no time", "wrong: EvaluationError: times of waypoints must increase"),
        ("raises", "wrong: KeyError: 'lost'"),
        ("steps", "wrong steps the world"),
        ("remembers", "wrong plans otherwise after a reset"),
        ("opened", "wrong plans otherwise when it is opened anew"),
        ("fingerprint", "wrong has no fingerprint, or more than one"),
    ],
)
def test_a_wrong_policy_is_caught(way: str, message: str) -> None:
    with pytest.raises(VerificationError, match=message):
        check_policy(WrongDriver(way))
