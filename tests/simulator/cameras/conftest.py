import pytest

from me2e_compress.simulator.camera_rig import CameraRig
from me2e_compress.simulator.cameras.ground import GroundTexture
from me2e_compress.simulator.cameras.renderer import Cameras
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
