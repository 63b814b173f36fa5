import numpy as np
import pytest
import torch
from torch.nn import functional

from models.stacks import TCP
from models.synthetic_frames import Frame, frames, interpolation, strip


@pytest.fixture(scope="module")
def frame() -> Frame:
    (made,) = frames(TCP, 1, seed=3)
    return made


def test_frames_have_the_inputs_of_the_stack(frame: Frame) -> None:
    assert {name: value.shape for name, value in frame.items()} == TCP.inputs
    assert {value.dtype for value in frame.values()} == {np.dtype(np.float32)}


def test_the_state_says_speed_target_and_command(frame: Frame) -> None:
    (state,), (target,) = frame["state"], frame["target_point"]
    assert 3 / 12 <= state[0] <= 10 / 12
    np.testing.assert_array_equal(state[1:3], target)
    np.testing.assert_array_equal(state[3:], [0, 0, 0, 1, 0, 0])
    assert target[0] > abs(target[1])


def test_the_strip_is_left_front_and_right() -> None:
    seen = np.zeros((6, 360, 640, 3), np.uint8)
    seen[[1, 0, 2]] += np.array([50, 100, 150], np.uint8)[:, None, None, None]
    row = strip(seen)[128, :, 0]
    np.testing.assert_allclose(row[[0, 313, 450, 586, 899]], [50, 50, 100, 150, 150])


def test_shrinking_is_torch_s_bilinear() -> None:
    line = np.random.default_rng(0).random(1600)
    row = torch.from_numpy(line)[None, None]
    want = functional.interpolate(row, 900, mode="linear")[0, 0].numpy()
    np.testing.assert_allclose(interpolation(1600, 900) @ line, want, atol=1e-5)
