import dataclasses
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.sample import FrameSubset
from me2e_compress.errors import FramesError
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.providers import CPU, CpuProvider, Provider
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
    np.testing.assert_array_equal(seen.checksums, whole.checksums)
    np.testing.assert_array_equal(seen.counted(), whole.counted())
    assert rest.left == 0
    assert not path.exists()


@dataclasses.dataclass(frozen=True)
class Elsewhere(CpuProvider):
    """The same kernels under another name."""

    name: ClassVar[str] = "elsewhere"


@dataclasses.dataclass(frozen=True)
class Other:
    """What a later calibration differs in from the one that was killed."""

    tensors: tuple[str, ...] = TENSORS
    method: str = "mse"
    optimize: bool = True
    provider: Provider = CPU
    model: int = 0
    first_image: int = 0
    last_frames: int = 6


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (Other(tensors=TENSORS[:1]), "another list of tensors"),
        (Other(method="max-min"), "another kind of statistics"),
        (Other(optimize=False), "another optimization level"),
        (Other(provider=Elsewhere()), "another provider"),
        (Other(model=1), "another model"),
        (Other(first_image=1), "another recording"),
        (Other(last_frames=2), "another choice of frames"),
    ],
)
def test_the_checkpoint_of_another_calibration_is_refused(
    folder: Path, tmp_path: Path, other: Other, message: str
) -> None:
    path = tmp_path / "standing.npz"
    with pytest.raises(KeyboardInterrupt):
        Calibrator("mse", threads=1, checkpoint=path, every=1).collect(
            conv_attention(), TENSORS, Killed(folder, 2)
        )
    images = [image(seed + other.first_image) for seed in range(6)]
    whole = CalibrationSet(record(tmp_path / "other", images, (0, 4)))
    frames = FrameSubset(whole, tuple(range(6))[-other.last_frames :])

    with pytest.raises(FramesError, match=f"stale: a checkpoint of {message};"):
        Calibrator(
            other.method, threads=1, optimize=other.optimize, checkpoint=path,
            provider=other.provider,
        ).collect(conv_attention(other.model), other.tensors, frames)  # fmt: skip


def test_a_file_that_is_no_checkpoint_is_refused(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "standing.npz"
    path.write_bytes(b"PK")

    with pytest.raises(FramesError, match="not a checkpoint"):
        Calibrator(threads=1, checkpoint=path).collect(
            conv_attention(), TENSORS, CalibrationSet(folder)
        )
