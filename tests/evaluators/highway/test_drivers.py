"""Drivers by name: their options, their fingerprints, those of other packages."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from me2e_compress.driving.contract import CAN_BUS_SIZE, Observation, Policy
from me2e_compress.driving.policies import Driver, driver_named
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.highway.blind import SPEEDS_MPS, Blind, centre_plan
from me2e_compress.evaluators.highway.drivers import OnnxDriver, image_size_of
from me2e_compress.metrics.episode import InfractionKind
from tests.evaluators.highway.drivers import straight_on
from tests.evaluators.highway.tiny_world import circle, ego_at, straight
from tests.installed import install
from tests.simulator.world.driving import drive_blind, route_of


def test_drivers_by_name() -> None:
    assert driver_named("blind").open() == Blind(8.0)
    assert driver_named("blind:6.5").open() == Blind(6.5)
    assert driver_named("onnx:a/m.onnx") == OnnxDriver(Path("a/m.onnx"))
    assert driver_named("mine.onnx") == OnnxDriver(Path("mine.onnx"))


@pytest.mark.parametrize("text", ["blind", "blind:6.5", "blind:8"])
def test_results_know_a_driver_by_its_text(text: str) -> None:
    assert driver_named(text).fingerprint() == text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("blind:fast", "blind: speed_mps: Input should be a valid number"),
        ("blind:0", "blind: 0 is not a speed in m/s"),
        ("blind{speed=3}", "blind has no option 'speed'; it has speed_mps"),
    ],
)
def test_a_wrong_option_of_a_driver_is_named(text: str, message: str) -> None:
    with pytest.raises(EvaluationError, match=message):
        driver_named(text)


@dataclass(frozen=True)
class StillDriver(Driver):
    """Stands still.

    Attributes:
        weights: Read by nobody.
    """

    name: ClassVar[str] = "still"
    weights: Path

    def open(self) -> Policy:
        return Blind(0.0)


def test_a_policy_of_another_package_drives_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = {"still": f"{__name__}:StillDriver"}
    install(monkeypatch, tmp_path, "a-policy", "me2e_compress.policies", entry)
    weights = tmp_path / "w"
    weights.write_bytes(b"1")
    driver = driver_named(f"still:{weights}")
    before = driver.fingerprint()
    weights.write_bytes(b"2")

    assert driver == StillDriver(weights)
    assert before != driver.fingerprint()
    assert image_size_of(driver.open()) == (96, 160)


def test_the_fingerprint_follows_the_files(tmp_path: Path) -> None:
    path, toml = straight_on(tmp_path / "m.onnx"), tmp_path / "a.toml"
    toml.write_text("axes = 'forward-left'")
    plain, adapted = OnnxDriver(path).fingerprint(), OnnxDriver(path, toml)

    assert adapted.fingerprint() != plain
    before = adapted.fingerprint()
    toml.write_text("axes = 'right-forward'")
    assert adapted.fingerprint() != before


# The driver that sees nothing.


@pytest.mark.parametrize("speed", SPEEDS_MPS)
def test_at_speed_the_waypoints_are_evenly_spaced(speed: float) -> None:
    plan = centre_plan(ego_at(speed=speed), straight(), 5.0, speed)
    np.testing.assert_allclose(plan[:, 0], speed * 0.5 * np.arange(1, 7))
    np.testing.assert_allclose(plan[:, 1], 0.0, atol=1e-9)


def test_it_reaches_its_speed_at_three_metres_a_second_squared() -> None:
    plan = centre_plan(ego_at(speed=5.0), straight(), 5.0, 8.0)
    assert plan[0, 0] == pytest.approx(5.0 * 0.5 + 3.0 * 0.5**2 / 2)
    assert plan[5, 0] == pytest.approx(5.0 + 3.0 / 2 + 8.0 * 2.0)


def test_it_bends_with_the_route() -> None:
    path = circle(12.0, 1.4)
    plan = centre_plan(ego_at(29.0, speed=6.0), path, 29.0, 6.0)
    offsets = [path.project(29.0 + x, y)[1] for x, y in plan]
    assert plan[5, 1] > 8.0
    np.testing.assert_allclose(offsets, 0.0, atol=0.05)


def test_it_drives_into_what_stands_there() -> None:
    faults = drive_blind(route_of("ParkedObstacle", 7), 8.0)
    assert [each.kind for each in faults] == [InfractionKind.COLLISION_VEHICLE]


def test_without_a_world_it_says_what_is_missing() -> None:
    nothing = Observation(
        *(0, None, np.zeros((6, 4, 4), np.float32)),
        can_bus=np.zeros(CAN_BUS_SIZE, np.float32),
        command=3,
        speed_mps=0.0,
    )
    with pytest.raises(EvaluationError, match="blind needs a highway-env world"):
        Blind().plan(nothing)
