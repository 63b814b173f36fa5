"""Write a recording, a folder of frames, atomically."""

import dataclasses
import json
import shutil
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, TypeAlias

from me2e_compress.base import atomic, documents
from me2e_compress.base.atomic import write_document
from me2e_compress.base.errors import FramesError
from me2e_compress.base.registry import Registry
from me2e_compress.calibration.dataset import PixelInput, PixelInputs, npz_bytes
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.providers import CPU, Provider

INDEX = "scenes.json"


PROGRESS = "progress.json"


@dataclasses.dataclass(frozen=True)
class Begin:
    """Where a recording resumes: the first missing frame, which begins a scene.

    ``place`` is the number of that scene among those that its source tries; some may
    give no frame.
    """

    frame: int = 0
    place: int = 0


# Yields the frames from the beginning of a scene on
Source: TypeAlias = Callable[[Begin], Iterable[Frame]]


def write_recording(
    folder: Path,
    source: Source,
    about: Mapping[str, str | int],
    key: str = "",
    pixels: Mapping[str, PixelInput] | None = None,
) -> Path:
    """Write a folder that `CalibrationSet` reads, atomically.

    An earlier recording in the folder is replaced. The same frames give the same bytes.
    ``about`` goes into ``scenes.json``; a run with the same ``about`` and ``key``
    resumes a killed one. ``pixels`` has the inputs that the source yields as bytes, by
    name.

    Raises:
        FramesError: there are no frames, or a folder holds something else.
    """
    _check_replaceable(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    # Write into a hidden folder beside it first, which may hold complete scenes of a
    # killed run
    partial = partial_folder(folder)
    _check_replaceable(partial, PROGRESS)
    described = dict[str, object](about)
    if pixels:
        described["pixels"] = PixelInputs(inputs=dict(pixels)).model_dump(mode="json")
    draft = _Draft(partial, described, key)
    try:
        # Resume at the first scene that is not complete.
        for frame in source(draft.resume()):
            draft.write(frame)
        if not draft.scenes:
            raise FramesError(f"{folder}: there are no frames to write")
        # The index makes the folder a recording; a kill may have left atomic.
        for leftover in partial.glob(f".{PROGRESS}.*"):
            leftover.unlink()
        count = {"count": draft.count}
        index = {**atomic.IN_JSON, "scenes": draft.scenes, **described, **count}
        with atomic.naming_file(partial / INDEX):
            (partial / INDEX).write_text(json.dumps(index, indent=1) + "\n")
        atomic.put_in_place(partial, folder)
        (folder / PROGRESS).unlink()
    finally:
        if len(draft.scenes) < 2:  # nothing to go on from
            shutil.rmtree(partial, ignore_errors=True)
    return folder


def partial_folder(folder: Path) -> Path:
    """Return the folder in which a recording is written until it is complete."""
    return folder.with_name(f".{folder.name}.partial")


class _Draft:
    """A recording in progress; see :func:`write_recording`."""

    def __init__(self, folder: Path, about: Mapping[str, object], key: str) -> None:
        self.folder, self.key = folder, [key, dict(about)]
        self.scenes: list[int] = []
        self.places: list[int] = []
        self.count = 0

    def resume(self) -> Begin:
        """Keep the complete scenes of an earlier run of the same frames, if any."""
        try:
            progress = documents.from_json((self.folder / PROGRESS).read_bytes())
        except (OSError, documents.MalformedError):
            progress = None
        if isinstance(progress, dict) and progress.get("key") == self.key:
            scenes, places = list(progress["scenes"]), list(progress["places"])
            if all(self._frame(index).is_file() for index in range(scenes[-1])):
                self.scenes, self.places = scenes[:-1], places[:-1]
                self.count = scenes[-1]
                return Begin(scenes[-1], places[-1])
        # Begin anew.
        self.folder.mkdir(exist_ok=True)  # it stays, because it may be locked
        for leftover in self.folder.iterdir():
            leftover.unlink()
        (self.folder / PROGRESS).touch()  # from now on it is known as ours
        return Begin()

    def write(self, frame: Frame) -> None:
        """Write a frame; where a scene begins, the ones before it are complete."""
        if frame.starts_scene:
            self.scenes.append(self.count)
            self.places.append(frame.place)
            record = {"scenes": self.scenes, "places": self.places}
            write_document(self.folder / PROGRESS, {"key": self.key, **record})
        path = self._frame(self.count)
        with atomic.naming_file(path):
            path.write_bytes(npz_bytes(frame.arrays, zipfile.ZIP_DEFLATED))
        self.count += 1

    def _frame(self, index: int) -> Path:
        return self.folder / f"{index:06d}.npz"


def _check_replaceable(folder: Path, mark: str = INDEX) -> None:
    """Refuse a folder that is not empty and holds anything but our frames."""
    if folder.is_symlink() and mark == PROGRESS:
        raise FramesError(f"{folder} is a link: frames that are unfinished go there")
    if not folder.exists():
        return
    if not folder.is_dir():
        raise FramesError(f"{folder} is a file, not a folder for frames")
    # An empty folder may be used.
    names = sorted(path.name for path in folder.iterdir())
    if not names:
        return
    if mark not in names:
        raise FramesError(f"{folder} is not empty, and no recording: it has {names[0]}")
    # Everything inside must have been written by us.
    for name in names:
        number = name.removesuffix(".npz")
        ours = name in (INDEX, PROGRESS) or name.startswith(f".{PROGRESS}.")
        if not ours and not (number != name and number.isdigit()):
            raise FramesError(f"{folder} holds frames but also {name}: not replaced")


# Recorded driving, which other packages read (docs/writing-logs.md).


@dataclass(frozen=True)
class LogRequest:
    """What frames a log is asked for.

    Attributes:
        model: the ONNX file, or the TOML of a stack, whose inputs they are.
        count: most frames in all.
        scene_length: most frames a scene; None means all.
        adapter: TOML file that adapts the model to the policy contract.
        provider: what opens the model.
    """

    model: Path
    count: int
    scene_length: int | None = None
    adapter: Path | None = None
    provider: Provider = CPU


@dataclass(frozen=True)
class DriveLog(ABC):
    """A data set of recorded driving."""

    name: ClassVar[str]

    @abstractmethod
    def frames(self, request: LogRequest, begin: Begin) -> Iterator[Frame]:
        """Yield frames of the inputs, from the beginning of a scene on; FramesError."""

    def pixels(self, request: LogRequest) -> Mapping[str, PixelInput]:
        """Return the inputs that are yielded as bytes, by name."""
        return {}


LOGS: Registry[DriveLog] = Registry(
    "driving log", "me2e_compress.logs", FramesError, {}
)
