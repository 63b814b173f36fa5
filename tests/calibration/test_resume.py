from pathlib import Path

import numpy as np
import pytest

from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.errors import FramesError
from me2e_compress.runtime.frames import Frame
from tests.frames import record
from tests.nets import conv_attention, image

TENSORS = ("image", "a", "seen", "mixed")


class Killed(CalibrationSet):
    """A recording whose reader dies at the n-th frame it reads."""

    def __init__(self, folder: Path, after: int) -> None:
        super().__init__(folder)
        self.left = after

    def __getitem__(self, index: int) -> Frame:
        if not self.left:
            raise KeyboardInterrupt
        self.left -= 1
        return super().__getitem__(index)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return record(tmp_path / "frames", [image(seed) for seed in range(6)], (0, 4))


@pytest.mark.parametrize("after", [1, 4, 6, 7, 11])
def test_a_killed_calibration_goes_on_where_it_was(
    folder: Path, tmp_path: Path, after: int
) -> None:
    path = tmp_path / "standing.npz"
    calibrator = Calibrator("mse", threads=1, checkpoint=path, every=2)
    model = conv_attention()
    with pytest.raises(KeyboardInterrupt):
        calibrator.collect(model, TENSORS, Killed(folder, after))

    rest = Killed(folder, 12 - after + after % 2)
    seen = calibrator.collect(model, TENSORS, rest)

    whole = Calibrator("mse", threads=1).collect(model, TENSORS, CalibrationSet(folder))
    np.testing.assert_array_equal(seen.measured, whole.measured)
    np.testing.assert_array_equal(seen.counted(), whole.counted())
    assert rest.left == 0
    assert not path.exists()


@pytest.mark.parametrize(
    ("tensors", "method", "seed", "message"),
    [
        (TENSORS[:1], "mse", 0, "another list of tensors"),
        (TENSORS, "max-min", 0, "another kind of statistics"),
        (TENSORS, "mse", 1, "another model"),
    ],
)
def test_the_checkpoint_of_another_calibration_is_refused(
    folder: Path,
    tmp_path: Path,
    tensors: tuple[str, ...],
    method: str,
    seed: int,
    message: str,
) -> None:
    path = tmp_path / "standing.npz"
    with pytest.raises(KeyboardInterrupt):
        Calibrator("mse", threads=1, checkpoint=path, every=1).collect(
            conv_attention(), TENSORS, Killed(folder, 2)
        )

    with pytest.raises(FramesError, match=rf"standing.npz: stale: .*{message}"):
        Calibrator(method, threads=1, checkpoint=path).collect(
            conv_attention(seed), tensors, CalibrationSet(folder)
        )


def test_a_file_that_is_no_checkpoint_is_refused(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "standing.npz"
    path.write_bytes(b"PK")

    with pytest.raises(FramesError, match="not a checkpoint"):
        Calibrator(threads=1, checkpoint=path).collect(
            conv_attention(), TENSORS, CalibrationSet(folder)
        )
