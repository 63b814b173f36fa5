"""Drivers by name: their options, their fingerprints, those of other packages."""

from pathlib import Path

import pytest

from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.policies import driver_named
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from models.driver.expert.blind import Blind
from tests.evaluators.highway.drivers import straight_on


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


def test_the_fingerprint_follows_the_files(tmp_path: Path) -> None:
    path, toml = straight_on(tmp_path / "m.onnx"), tmp_path / "a.toml"
    toml.write_text("axes = 'forward-left'")
    plain, adapted = OnnxDriver(path).fingerprint(), OnnxDriver(path, toml)

    assert adapted.fingerprint() != plain
    before = adapted.fingerprint()
    toml.write_text("axes = 'right-forward'")
    assert adapted.fingerprint() != before
