"""Sizes are looked at before anything is read."""

import zipfile
from pathlib import Path

import numpy as np
import pytest

from me2e_compress.calibration import dataset
from me2e_compress.calibration.dataset import load_arrays
from me2e_compress.errors import FramesError
from tests.fuzz.frames import archive, broken_frames, member


@pytest.fixture
def unread(monkeypatch: pytest.MonkeyPatch) -> None:
    def read(*_: object, **__: object) -> None:
        raise AssertionError("an array was read")

    monkeypatch.setattr(np, "load", read)


@pytest.mark.usefixtures("unread")
def test_a_zip_bomb_is_not_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dataset, "LARGEST_BYTES", 1_000_000)
    bomb = archive({"x.npy": member("(1000000,)", more=4_000_000)})
    assert len(bomb) < 5_000
    (tmp_path / "bomb.npz").write_bytes(bomb)
    with pytest.raises(FramesError, match="arrays have 4,000,000 bytes, more than"):
        load_arrays(tmp_path / "bomb.npz")


FRAMES = dict(broken_frames())
READABLE = ("extra", "extra-markup", "missing", "double", "half-float", "complex",
            "words", "dates", "fields", "void", "bytes", "flat", "scalar",
            "no-elements", "other-shape", "nan", "infinite", "largest",
            "path", "no-member")  # fmt: skip
"""Archives that are whole, whatever a model says of them."""


@pytest.mark.parametrize("name", FRAMES)
def test_an_archive_that_lies_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "x.npz").write_bytes(FRAMES[name])
    if name in READABLE:
        load_arrays(tmp_path / "x.npz")
        return
    with pytest.raises(FramesError, match=r"x\.npz: not a readable \.npz") as caught:
        load_arrays(tmp_path / "x.npz")
    assert "\n" not in str(caught.value)


def test_an_archive_that_breaks_without_a_word_is_told_by_the_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*given: object) -> None:
        raise EOFError

    (tmp_path / "x.npz").write_bytes(b"")
    monkeypatch.setattr(zipfile, "ZipFile", broken)

    with pytest.raises(FramesError, match=r"not a readable \.npz \(EOFError\)$"):
        load_arrays(tmp_path / "x.npz")
