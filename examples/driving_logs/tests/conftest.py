"""The small logs, written once for each module of tests."""

from pathlib import Path

import pytest

from driving_logs.moments import CameraLog
from read_logs import opened
from small_logs import MAKERS


@pytest.fixture(scope="module")
def roots(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {name: make(tmp_path_factory.mktemp(name)) for name, make in MAKERS.items()}


@pytest.fixture(params=MAKERS)
def log(request: pytest.FixtureRequest, roots: dict[str, Path]) -> CameraLog:
    name: str = request.param
    return opened(f"{name}:{roots[name]}")
