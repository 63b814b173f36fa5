"""Drivers by name: their options, their fingerprints, those of other packages."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest

from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.contract import Policy
from me2e_compress.driving.policies import Driver, driver_named
from me2e_compress.evaluators.highway.drivers import OnnxDriver, image_size_of
from models.driver.expert.blind import Blind
from tests.evaluators.highway.drivers import straight_on
from tests.support.installed import install


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
