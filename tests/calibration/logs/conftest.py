"""The small logs, written once for each module of tests."""

from pathlib import Path

import pytest

from me2e_compress.calibration.logs import LOGS, DriveLog
from tests.calibration.logs.small_logs import MAKERS


@pytest.fixture(scope="module")
def roots(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {name: make(tmp_path_factory.mktemp(name)) for name, make in MAKERS.items()}


@pytest.fixture(params=MAKERS)
def log(request: pytest.FixtureRequest, roots: dict[str, Path]) -> DriveLog:
    name: str = request.param
    return LOGS.parse(f"{name}:{roots[name]}")
