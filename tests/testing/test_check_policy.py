import itertools
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from me2e_compress.driving.contract import Observation, Plan, Policy, RouteInfo
from me2e_compress.driving.policies import Driver
from me2e_compress.errors import VerificationError
from me2e_compress.evaluators.highway.drivers import (
    BlindDriver,
    ExpertDriver,
    OnnxDriver,
)
from me2e_compress.simulator.scene import Control
from me2e_compress.simulator.world import World
from me2e_compress.testing import check_policy
from tests.evaluators.highway.drivers import straight_on

AHEAD = np.array([[2.0 * k, 0.0] for k in range(1, 7)])


@pytest.mark.parametrize("driver", [BlindDriver(6.0), ExpertDriver()])
def test_our_policies_hold(driver: Driver) -> None:
    assert len(check_policy(driver)) == 8


def test_a_recurrent_model_holds(tmp_path: Path) -> None:
    model = straight_on(
        tmp_path / "m.onnx",
        inputs="float[1] count",
        outputs="float[1, 6, 2] plan, float[1] count_out",
        body="count_out = Add (count, one)\nplan = Mul (ahead, count_out)",
        initializers=", float[1] one = {1.0}",
    )

    plans = check_policy(OnnxDriver(model))

    assert plans[7].tolist() == (plans[0] * 8).tolist()


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

    def plan(self, observation: Observation) -> Plan:
        self.asked += 1
        if self.way == "shape":
            return AHEAD[:5]
        if self.way == "not finite":
            return np.where(AHEAD > 5, np.inf, AHEAD)
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


def test_what_errs_in_no_way_holds() -> None:
    assert np.array_equal(check_policy(WrongDriver())[0], AHEAD)


@pytest.mark.parametrize(
    ("way", "message"),
    [
        ("shape", r"wrong: the plan has shape \[5, 2\], it must be \[6, 2\]"),
        ("not finite", "wrong: the plan is not finite"),
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
