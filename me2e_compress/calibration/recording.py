"""Write a recording: a folder of frames, whole or not there."""

import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from me2e_compress.errors import FramesError
from me2e_compress.runtime.frames import Array, Frame

INDEX = "scenes.json"


def write_recording(
    folder: Path, frames: Iterable[Frame], about: Mapping[str, str | int]
) -> Path:
    """Write a folder that `CalibrationSet` reads, all or nothing.

    One ``000000.npz`` a frame, keyed by input name, and ``scenes.json``, which says
    where scenes begin. A folder that holds an earlier recording of ours is replaced.
    The same frames give the same bytes.

    Args:
        folder: To write.
        frames: In order; the first starts a scene.
        about: What ``scenes.json`` also says: the model, the seed.

    Returns:
        The folder.

    Raises:
        FramesError: No frames, or the folder holds something else.
    """
    _check_replaceable(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    draft = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}-"))
    try:
        draft.chmod(0o755)
        scenes, count = list[int](), 0
        for count, frame in enumerate(frames, 1):
            _write_npz(draft / f"{count - 1:06d}.npz", frame.arrays)
            if frame.starts_scene:
                scenes.append(count - 1)
        if not count:
            raise FramesError(f"{folder}: there are no frames to write")
        index = {"scenes": scenes, **about, "count": count}
        (draft / INDEX).write_text(json.dumps(index, indent=1) + "\n")
        if folder.exists():
            shutil.rmtree(folder)
        os.replace(draft, folder)
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    return folder


def _check_replaceable(folder: Path) -> None:
    if not folder.exists():
        return
    if not folder.is_dir():
        raise FramesError(f"{folder} is a file, not a folder for frames")
    names = sorted(path.name for path in folder.iterdir())
    if not names:
        return
    if INDEX not in names:
        raise FramesError(f"{folder} is not empty, and no recording: it has {names[0]}")
    for name in names:
        if name != INDEX and not (name.endswith(".npz") and name[:-4].isdigit()):
            raise FramesError(f"{folder} holds frames but also {name}: not replaced")


def _write_npz(path: Path, arrays: Mapping[str, Array]) -> None:
    """Like numpy.savez_compressed, at a fast level; the same frame, the same bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, value in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy")
            entry.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(entry, "w", force_zip64=True) as file:
                np.lib.format.write_array(file, value, allow_pickle=False)
