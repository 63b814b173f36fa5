"""The driver that ships is a policy by its name, everywhere."""

from pathlib import Path

from me2e_compress.commands.evaluate import driver_of
from me2e_compress.commands.options import GraphOptions
from me2e_compress.driving.policies import driver_named
from me2e_compress.evaluators.highway.drivers import image_size_of
from me2e_compress.shipped.drivers import shipped_model
from me2e_compress.study import load_study

STUDY = """
title = "Half of it"
baseline = "half"
routes = 1
[[variant]]
name = "half"
policy = "highway"
passes = "convert-float16"
[[condition]]
name = "ideal"
latency = "none"
"""


def test_it_is_found_by_name() -> None:
    driver = driver_named("highway")

    assert driver.label == "highway"
    by_file = driver_named(str(shipped_model("highway"))).fingerprint()
    assert (
        driver.fingerprint()
        == driver_of("highway", GraphOptions()).fingerprint()
        == by_file
    )
    assert image_size_of(driver.open()) == (96, 160)


def test_a_study_may_compress_it(tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text(STUDY)

    (half,) = load_study(tmp_path / "study.toml").variants

    assert Path(half.policy) == shipped_model("highway")
    assert [each.name for each in half.passes] == ["convert-float16"]
