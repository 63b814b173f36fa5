"""One export and one torch model for all tests; hooks are those of `tests`."""

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from numpy.typing import NDArray

from models.stacks import VAD_TINY
from models.synthetic_frames import Frame, frames
from models.tests.truth import Truth, truth_of
from models.tests.vad.sizes import SIZES, VadSize
from models.vad.stack import VadTiny
from tests.conftest import (
    opened_before,
    pytest_collection,
    pytest_collection_finish,
    pytest_configure,
)

__all__ = [
    "opened_before",
    "pytest_collection",
    "pytest_collection_finish",
    "pytest_configure",
]


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> None:
    """Tests run side by side; torch's threads wait for each other by spinning."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def scenes() -> list[Frame]:
    """Two scenes of two frames, of a seed that no calibration saw."""
    return list(frames(VAD_TINY, 4, seed=7, scene_length=2))


@pytest.fixture(scope="session")
def vad_scenes(vad_size: VadSize) -> list[Frame]:
    """The same scenes as cameras of this size see them."""
    return list(frames(vad_size.stack, 4, seed=7, scene_length=2))


@pytest.fixture(scope="session")
def no_bev(vad_size: VadSize) -> NDArray[np.float32]:
    """The recurrent state at the start of a scene."""
    return np.zeros(vad_size.stack.inputs["prev_bev"], np.float32)


@pytest.fixture(
    scope="session",
    params=["small", pytest.param("published", marks=pytest.mark.slow)],
)
def vad_size(request: pytest.FixtureRequest) -> VadSize:
    """How large VAD-tiny is: what runs at its published size is slow."""
    return SIZES[request.param]


@pytest.fixture(scope="session")
def vad_tiny(vad_size: VadSize, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The exported reference stack, seed 0, opset 17, nuScenes heads."""
    return vad_size.export(tmp_path_factory.mktemp("vad") / "vad-tiny.onnx")


@pytest.fixture(scope="session")
def vad_torch(vad_size: VadSize) -> VadTiny:
    """The same in torch."""
    return vad_size.build()


@pytest.fixture(scope="session")
def vad_truth(vad_size: VadSize, vad_tiny: Path, vad_torch: VadTiny) -> Truth:
    """What its trace knew: the module of every node, and torch's own MACs."""
    plain = onnx.load(vad_tiny, load_external_data=False)
    return truth_of(vad_size.stack, vad_torch, plain=plain)
