import pytest

from me2e_compress.simulator.cameras import CameraRig, Cameras, GroundTexture
from tests.simulator.cameras import town


@pytest.fixture(scope="session")
def texture() -> GroundTexture:
    return town.paint()


@pytest.fixture(scope="session")
def rig() -> CameraRig:
    return CameraRig(128, 224)


@pytest.fixture(scope="session")
def cameras(texture: GroundTexture, rig: CameraRig) -> Cameras:
    return Cameras(texture, rig)
