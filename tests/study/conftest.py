"""Small studies: two short routes, drivers that need no images."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from me2e_compress.evaluators.highway import runner
from me2e_compress.study import (
    Condition,
    Study,
    StudyResult,
    Timing,
    Variant,
    run_study,
)
from tests.evaluators.highway.drivers import CROSSING, PARKED, straight_on
from tests.support.command import write_frames
from tests.support.in_process import Here

ROUTES = (CROSSING, PARKED)
IDEAL, SLOW = Condition("ideal", "none"), Condition("slow", "fps:2")
BLIND = Variant("blind", "blind:6")
FASTER = Variant("faster", "blind:9")
TWICE_AS_FAR = "factor = Constant <value_float = 2.0> () plan = Mul (ahead, factor)"

Make = Callable[..., Study]


@pytest.fixture(scope="session")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder: slow.onnx drives 4 m/s, fast.onnx 8 m/s, frames fit both."""
    folder = tmp_path_factory.mktemp("models")
    straight_on(folder / "slow.onnx")
    straight_on(folder / "fast.onnx", body=TWICE_AS_FAR)
    write_frames(folder / "frames", command=np.array([3]))
    return folder


@pytest.fixture
def make(models: Path) -> Make:
    """Give a study of the slow model, its exact form and the fast one; change it."""

    def made(**changes: object) -> Study:
        return dataclasses.replace(asked(models), **changes)  # type: ignore[arg-type]

    return made


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which the study of `result` ran."""
    return tmp_path_factory.mktemp("study")


@pytest.fixture(scope="session")
def result(models: Path, folder: Path) -> StudyResult:
    """The result of the study, whose routes end after some seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "TIMEOUT_US", 16_000_000)
        return run_study(asked(models), folder, Here())


def asked(models: Path) -> Study:
    return Study(
        "Slow & <fast>",
        (
            BLIND,
            Variant("slow", str(models / "slow.onnx")),
            Variant("again", str(models / "slow.onnx")),
            Variant("fast", str(models / "fast.onnx")),
        ),
        (IDEAL, SLOW),
        "slow",
        ROUTES,
        220,
        held_out=models / "frames",
        timing=Timing(20, baseline_median_s=0.2),
    )
