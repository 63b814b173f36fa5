import dataclasses
from pathlib import Path

import numpy as np
import pytest

from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.sample import draw, shard
from me2e_compress.calibration.statistics import Statistics, merge
from me2e_compress.errors import FramesError
from tests.frames import record
from tests.nets import conv_attention, image

TENSORS = ("image", "a", "seen", "mixed")
SCENES = (0, 2, 3, 5)


@pytest.fixture
def frames(tmp_path: Path) -> CalibrationSet:
    draws = [image(seed) for seed in range(7)]
    for at, frame in enumerate(draws):
        frame["image"] *= np.float32(2**at)
    return CalibrationSet(record(tmp_path / "frames", draws, SCENES))


def same(a: Statistics, b: Statistics) -> bool:
    return (
        (a.model, a.source, a.tensors, a.frames)
        == (b.model, b.source, b.tensors, b.frames)
        and (a.inputs, a.outputs, a.scenes) == (b.inputs, b.outputs, b.scenes)
        and np.array_equal(a.checksums, b.checksums)
        and np.array_equal(a.measured, b.measured)
        and np.array_equal(a.counted(), b.counted())
    )


@pytest.mark.parametrize("count", [2, 3, 4])
def test_merged_shards_are_one_calibration_to_the_bit(
    frames: CalibrationSet, count: int
) -> None:
    calibrator = Calibrator("percentile", threads=1)
    model = conv_attention()
    whole = draw(frames, 7, 0)
    parts = [shard(whole, number, count) for number in range(1, count + 1)]

    seen = [calibrator.collect(model, TENSORS, part) for part in parts]

    assert all(len(part) for part in parts)
    assert same(merge(seen[::-1]), calibrator.collect(model, TENSORS, frames))


def test_saved_statistics_come_back_byte_for_byte(
    frames: CalibrationSet, tmp_path: Path
) -> None:
    seen = Calibrator("mse", threads=1).collect(conv_attention(), TENSORS, frames)
    seen.save(tmp_path / "a.npz")

    again = Statistics.load(tmp_path / "a.npz")
    again.save(tmp_path / "b.npz")

    assert same(seen, again)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_a_file_that_holds_no_statistics_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.npz"
    with pytest.raises(FramesError, match="no such statistics"):
        Statistics.load(path)
    path.write_bytes(b"PK")
    with pytest.raises(FramesError, match="not saved statistics"):
        Statistics.load(path)
    np.savez(path, model="m")
    with pytest.raises(FramesError, match="not saved statistics"):
        Statistics.load(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model": "other"}, "model of frames 5 to 6 is not that of frames 0 to 4"),
        ({"source": "other"}, "source of frames"),
        ({"tensors": ("x",)}, "tensors of frames"),
        ({"counts": np.zeros((4, 2048), np.int64)}, "some of the shards have hist"),
        ({"frames": (4, 5)}, "frame 4 is in two"),
    ],
)
def test_shards_that_do_not_belong_together_are_refused(
    frames: CalibrationSet, change: dict[str, object], message: str
) -> None:
    whole = draw(frames, 7, 0)
    model = conv_attention()
    first, second = (
        Calibrator("max-min", threads=1).collect(model, TENSORS, part)
        for part in (
            dataclasses.replace(whole, places=tuple(range(5))),
            dataclasses.replace(whole, places=(5, 6)),
        )
    )
    wrong = dataclasses.replace(second, **change)  # type: ignore[arg-type]

    with pytest.raises(FramesError, match=message):
        merge([first, wrong])
    with pytest.raises(FramesError, match="no shards"):
        merge([])


def test_frames_are_drawn_by_seed_in_whole_scenes(frames: CalibrationSet) -> None:
    drawn = [draw(frames, 4, seed).places for seed in range(20)]

    assert draw(frames, 4, 7).places == drawn[7]
    assert len(set(drawn)) > 5
    for places in drawn:
        assert list(places) == sorted(set(places))
        assert len(places) == 4
        for place in places:
            assert place in SCENES or place - 1 in places
    assert draw(frames, 99, 3).places == tuple(range(7))


def test_a_shard_that_cannot_be_is_refused(frames: CalibrationSet) -> None:
    with pytest.raises(FramesError, match="0 frames were asked for"):
        draw(frames, 0, 0)
    with pytest.raises(FramesError, match="no shard 3 of 2"):
        shard(draw(frames, 7, 0), 3, 2)
    with pytest.raises(FramesError, match="4 scenes cannot be shared by 5"):
        shard(draw(frames, 7, 0), 1, 5)
