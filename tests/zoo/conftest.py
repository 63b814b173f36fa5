"""One export and one torch model for all tests of the zoo."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from me2e_compress.zoo.stacks import VAD_TINY
from me2e_compress.zoo.synthetic_frames import Frame, frames
from tests.zoo.vad.sizes import VadSize


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
