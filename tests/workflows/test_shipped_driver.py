"""The driver that ships is a policy by its name, everywhere."""

from me2e_compress.driving.policies import driver_named
from me2e_compress.evaluators.highway.drivers import image_size_of
from me2e_compress.passes import PASSES
from me2e_compress.study import Variant
from me2e_compress.workflows.evaluate import driver_of
from me2e_compress.zoo.shipped import shipped


def test_it_is_found_by_name() -> None:
    driver = driver_named("highway")

    assert driver.label == "highway"
    assert driver.fingerprint() == driver_named(str(shipped("highway"))).fingerprint()


def test_a_study_may_compress_it() -> None:
    assert Variant("small", "highway", (PASSES.parse("fuse-basic"),)).is_model


def test_evaluate_takes_its_file() -> None:
    assert driver_of("highway").fingerprint() == driver_named("highway").fingerprint()


def test_it_opens() -> None:
    assert image_size_of(driver_named("highway").open()) == (96, 160)
