"""Recorded frames, in scenes, for calibration and fidelity.

A recording is a folder with one ``.npz`` a frame, keyed by input name and ordered by
file name, and ``scenes.json``: ``{"scenes": [0, 64, ...]}``, the index of the first
frame of every scene. Images may lie there as bytes, and are normalised when they are
read: six of 1600 x 928 have 107 MB as float32 and 27 MB as bytes. ``scenes.json`` lists
such inputs: ``{"pixels": {"version": 1, "inputs": {"img": {"mean": ..., ...}}}}``; a
reader that does not know the key refuses the bytes, whose type and shape do not fit.
"""

import bisect
import copy
import dataclasses
import hashlib
import io
import itertools
import json
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, Self, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt
import onnx_ir as ir
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, PositiveInt

from me2e_compress.base import atomic, documents
from me2e_compress.base.display import error_line
from me2e_compress.base.documents import NPZ_ERRORS, check_regular
from me2e_compress.base.errors import FramesError, PreconditionError
from me2e_compress.graph import array_of, static_shape
from me2e_compress.graph.recurrence import not_fed_back, recurrent_inputs, sides
from me2e_compress.runtime.frames import Array, Frame

# The most bytes of all arrays of one file. Six full-size camera images have 0.1 GB.
LARGEST_BYTES = 2 << 30


@dataclasses.dataclass(frozen=True)
class Header:
    """Shape and type of an array that need not be there."""

    shape: tuple[int, ...]
    dtype: np.dtype[np.generic]


def load_arrays(path: Path, what: str = "a readable .npz") -> dict[str, Array]:
    """Read every array of an ``.npz`` by name, unless they are larger than memory.

    Raises:
        FramesError: the file is no archive of arrays of numbers or text, or these have
            more than 2 GiB; ``what`` is the expected content, for the message.
    """
    try:
        check_regular(path)
        with path.open("rb") as source, zipfile.ZipFile(source) as archive:
            total = sum(entry.file_size for entry in archive.infolist())
        if total > LARGEST_BYTES:
            raise ValueError(
                f"its arrays have {total:,} bytes, more than {LARGEST_BYTES:,}"
            )
        with path.open("rb") as source, np.load(source, allow_pickle=False) as content:
            arrays = dict(content.items())
        if raw := [name for name, array in arrays.items() if isinstance(array, bytes)]:
            raise ValueError(f"{raw[0]} is no array")
    except NPZ_ERRORS as error:
        raise FramesError(f"{path}: not {what} ({error_line(error)})") from error
    return arrays


def npz_bytes(
    arrays: Mapping[str, Array], compression: int = zipfile.ZIP_STORED
) -> bytes:
    """Return an ``.npz`` of arrays; equal arrays give equal bytes."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", compression) as archive:
        archive.comment = atomic.BYTES
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(
                    entry, np.asanyarray(array), allow_pickle=False
                )
    return content.getvalue()


_PositiveFloat: TypeAlias = Annotated[FiniteFloat, Field(gt=0)]

CHANNELS = 3


class PixelInput(BaseModel):
    """An image input stored as bytes: (pixel - mean) / std, padded with zeros.

    On disk it is uint8 [..., 3, h, w], its planes in the order of the model; fed it is
    float32 [..., 3, rows, columns], zero below and to the right of the picture, as
    mmdetection pads after it normalises.

    Attributes:
        mean: in grey levels 0 to 255, for each plane.
        std: in grey levels, for each plane.
        order: order of the planes: red first or blue first.
        rows: rows of the input.
        columns: columns of the input.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    mean: tuple[FiniteFloat, FiniteFloat, FiniteFloat]
    std: tuple[_PositiveFloat, _PositiveFloat, _PositiveFloat]
    order: Literal["rgb", "bgr"]
    rows: PositiveInt
    columns: PositiveInt

    def fed_header(self, stored: Array) -> Header:
        """Return shape and type when it is fed; ValueError if it is no such bytes."""
        if stored.dtype != np.uint8:
            raise ValueError(f"is {stored.dtype}, pixels are uint8")
        if len(stored.shape) < CHANNELS or stored.shape[-3] != CHANNELS:
            raise ValueError(
                f"has shape {list(stored.shape)}, pixels are [..., 3, h, w]"
            )
        if stored.shape[-2] > self.rows or stored.shape[-1] > self.columns:
            raise ValueError(
                f"has shape {list(stored.shape)}, more than {self.rows} rows or"
                f" {self.columns} columns"
            )
        shape = (*stored.shape[:-2], self.rows, self.columns)
        return Header(shape, np.dtype(np.float32))

    def normalise(self, stored: Array) -> npt.NDArray[np.float32]:
        """Return the input, float32 [..., 3, rows, columns]; raises as `fed_header`."""
        shape = self.fed_header(stored).shape
        height, width = stored.shape[-2:]
        ready = np.zeros(shape, np.float32)
        picture = ready[..., :height, :width]
        picture[...] = stored
        picture -= np.array(self.mean, np.float32)[:, None, None]
        picture /= np.array(self.std, np.float32)[:, None, None]
        return ready


class PixelInputs(BaseModel):
    """The entry ``pixels`` of ``scenes.json``: a version, and inputs by name."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    version: Literal[1] = 1
    inputs: dict[str, PixelInput] = {}


T = TypeVar("T", Array, Header)

# Keys of `scenes.json`: two are read, the others say who wrote it.
_KEYS = ("scenes", "pixels", "generator", "stack", "seed", "log", "count")
# Metadata key of a graph: JSON with a digest of every input that became constant.
FROZEN_INPUTS = "me2e.static_inputs"


class CalibrationSet:
    """A recording on disk, or a part of one, read frame by frame.

    Attributes:
        folder: that of the recording.
        files: of all its frames.
        places: indices of these frames in the whole recording.

    Raises:
        FramesError: no such folder, no frames, or scenes.json is missing or malformed.
    """

    def __init__(self, folder: str | Path) -> None:
        folder = Path(folder)
        if not folder.is_dir():
            raise FramesError(f"{folder}: no such folder")
        self.folder = folder
        self.files = tuple(sorted(folder.glob("*.npz")))
        if not self.files:
            raise FramesError(f"{folder}: holds no .npz frames")
        if odd := [file for file in self.files if not file.is_file()]:
            raise FramesError(f"{odd[0]}: not a regular file")
        # The index tells where scenes begin, and what is pixels.
        path = folder / "scenes.json"
        if not path.is_file():
            raise FramesError(
                f'{path}: missing; {{"scenes": [0]}} if the frames are one scene'
            )
        with documents.reading(path, FramesError, "not JSON"):
            content = documents.from_json(documents.read_bytes(path))
        index = content if isinstance(content, dict) else {}
        self.places: Sequence[int] = range(len(self.files))
        # Scenes ascend from 0
        starts, count = index.get("scenes"), len(self.files)
        if not isinstance(starts, list) or not all(type(at) is int for at in starts):
            raise FramesError(f'{path}: must hold {{"scenes": [0, ...]}}')
        rising = all(a < b for a, b in itertools.pairwise(starts))
        if not starts or starts[0] != 0 or not rising or starts[-1] >= count:
            raise FramesError(
                f"{path}: scenes must rise from 0 and stay below the {count} frames,"
                f" found {starts}"
            )
        self._starts = tuple(starts)
        if unknown := [key for key in index if key not in _KEYS]:
            raise FramesError(
                f"{path}: unknown key {unknown[0]!r}; there are {', '.join(_KEYS)}"
            )
        # Old recordings, and those without pixels, have no such entry
        pixels = index.get("pixels")
        with documents.reading(path, FramesError, "pixels"):
            entry = (
                PixelInputs() if pixels is None else PixelInputs.model_validate(pixels)
            )
        self.pixels = entry.inputs

    def part(self, places: Iterable[int]) -> Self:
        """Return the frames at indices of the whole; after a gap a scene starts."""
        part = copy.copy(self)
        part.places = tuple(places)
        return part

    @property
    def scenes(self) -> tuple[int, ...]:
        """Positions among these frames where a scene begins."""
        return tuple(at for at in range(len(self)) if self._starts_scene(at))

    def _starts_scene(self, index: int) -> bool:
        place = self.places[index]
        return not index or place in self._starts or place - 1 != self.places[index - 1]

    def __len__(self) -> int:
        return len(self.places)

    def __iter__(self) -> Iterator[Frame]:
        """Read the frames in order, one in memory at a time."""
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> Frame:
        """Read one frame and normalise its pixels; its index is that in the whole."""
        place = self.places[index]
        path = self.files[place]
        arrays = self._convert_pixels(path, load_arrays(path), PixelInput.normalise)
        return Frame(place, self._starts_scene(index), arrays)

    def _convert_pixels(
        self,
        path: Path,
        arrays: Mapping[str, Array],
        convert: Callable[[PixelInput, Array], T],
    ) -> dict[str, Array | T]:
        """Return a frame's arrays with its pixel inputs converted."""
        ready: dict[str, Array | T] = dict(arrays)
        for name, pixels in self.pixels.items():
            try:
                if name in arrays:
                    ready[name] = convert(pixels, arrays[name])
            except ValueError as error:
                raise FramesError(f"{path}: {name} {error}") from error
        return ready

    @property
    def fingerprint(self) -> str:
        """A digest of the whole: it changes with its content, order or scenes."""
        digest = hashlib.blake2b(digest_size=16)
        digest.update(repr(self._starts).encode())
        if self.pixels:
            digest.update(repr(sorted(self.pixels.items())).encode())
        # The directory of each archive has checksums (CRC-32 and size of each array),
        # so that the arrays need not be read
        for path in self.files:
            try:
                with zipfile.ZipFile(path) as archive:
                    entries = sorted(
                        (member.filename, member.file_size, member.CRC)
                        for member in archive.infolist()
                    )
            except (OSError, zipfile.BadZipFile) as error:
                line = error_line(error)
                raise FramesError(f"{path}: not a readable .npz ({line})") from error
            digest.update(repr(entries).encode())
        return digest.hexdigest()

    def check(self, model: ir.Model) -> None:
        """Read every frame of the whole once and check it against a model's inputs.

        An array that is missing, unknown, of another shape or dtype, or not finite is a
        FramesError.
        """
        # Constants may be there, with the same values
        frozen, weights = frozen_inputs(model), model.graph.initializers
        inputs = [str(value.name) for value in model.graph.inputs]
        for name in self.pixels:
            if name not in inputs and name not in frozen:
                raise FramesError(
                    f"{self.folder / 'scenes.json'}: pixels: {name} is not an input of"
                    f" the model; it takes {', '.join(inputs)}"
                )
        for path in self.files:
            # Names, types and shapes first, as they are fed
            arrays = load_arrays(path)
            ports = self._convert_pixels(path, arrays, PixelInput.fed_header)
            for name in ports:
                if (array := array_of(weights.get(name))) is not None:
                    frozen.setdefault(name, digest_of(array))
            inputs_fed = {name: ports[name] for name in ports if name not in frozen}
            _check_frame(inputs_fed, model, str(path))
            # Then numbers
            for name, array in arrays.items():
                if array.dtype.kind == "f" and not np.isfinite(array).all():
                    kind = "NaN" if np.isnan(array).any() else "infinite"
                    at = np.argwhere(~np.isfinite(array))[0].tolist()
                    raise FramesError(
                        f"{path}: {name} is {kind} at {at}, expected finite numbers"
                    )
                if name in frozen and digest_of(array) != frozen[name]:
                    line = "is not the one that the graph was made for, a constant"
                    raise FramesError(f"{path}: {name} {line}")


def frozen_inputs(model: ir.Model) -> dict[str, str]:
    """Read the digests of inputs that ``freeze-inputs`` made constants."""
    try:
        return dict(json.loads(model.metadata_props.get(FROZEN_INPUTS, "{}")))
    except (TypeError, ValueError, RecursionError):
        return {}


def digest_of(array: Array) -> str:
    """Return a digest of an array's type, shape and content."""
    head = repr((array.dtype.str, array.shape)).encode()
    return hashlib.blake2b(head + array.tobytes(), digest_size=16).hexdigest()


def _check_frame(
    frame: Mapping[str, Header | Array], model: ir.Model, source: str
) -> None:
    """Raise a FramesError where names, dtypes or shapes are not the model's."""
    ports = {str(value.name): value for value in model.graph.inputs}
    # Recurrent inputs may come from the model itself.
    optional = recurrent_inputs(model)
    for name, value in ports.items():
        array = frame.get(name)
        if array is not None:
            check_array(array, value, f"{source}: {name}")
        elif name not in optional:
            raise FramesError(
                f"{source}: {name} is missing; there is {', '.join(frame)}"
                f"{not_fed_back(name, *sides(model))}"
            )
    if unknown := [name for name in frame if name not in ports]:
        raise FramesError(
            f"{source}: {unknown[0]} is not an input of the model;"
            f" it takes {', '.join(ports)}"
        )


def check_array(array: Header | Array, value: ir.Value, label: str) -> None:
    """Raise a FramesError where an array has not an input's dtype and shape."""
    if value.dtype is not None and array.dtype != value.dtype.numpy():
        raise FramesError(f"{label} is {array.dtype}, expected {value.dtype.numpy()}")
    if value.shape is not None and not _matches(array.shape, value.shape):
        raise FramesError(
            f"{label} has shape {list(array.shape)}, expected {value.shape}"
        )


def _matches(shape: tuple[int, ...], expected: ir.Shape) -> bool:
    return len(shape) == len(expected) and all(
        not isinstance(want, int) or have == want
        for have, want in zip(shape, expected, strict=True)
    )


def draw_frames(model: ir.Model, *, seed: int, count: int) -> Iterator[Frame]:
    """Draw random inputs for a model: one scene of ``count`` frames.

    They show that two graphs compute the same, but differ from real inputs, so nothing
    is calibrated on them. Recurrent inputs are left to the replay. An input of an open
    shape, or that is not of numbers, is a PreconditionError.
    """
    open_state = recurrent_inputs(model)
    ports = [value for value in model.graph.inputs if value.name not in open_state]
    # Refuse inputs that cannot be drawn before any frame is.
    for value in ports:
        if static_shape(value) is None or value.dtype is None:
            raise PreconditionError(
                f"input {value.name} is {value.type} {value.shape}: seeded inputs need"
                " a static shape, give frames instead, or sizes"
                " (compress --set-dim)"
            )
        tensors = isinstance(value.type, ir.TensorType)
        if not tensors or value.dtype.numpy().kind not in "fiub":
            raise PreconditionError(
                f"input {value.name} is {value.type}: seeded inputs are numbers"
            )
    # Frames are drawn lazily, all from one generator.
    generator = np.random.default_rng(seed)

    def draw_array(value: ir.Value) -> Array:
        shape = static_shape(value) or ()
        dtype = np.dtype(np.float32) if value.dtype is None else value.dtype.numpy()
        # Floats are standard normal, integers and booleans 0 or 1
        if dtype.kind == "f":
            return np.asarray(generator.standard_normal(shape)).astype(dtype)
        return np.asarray(generator.integers(0, 2, shape)).astype(dtype)

    return (
        Frame(index, index == 0, {str(v.name): draw_array(v) for v in ports})
        for index in range(count)
    )


def draw(whole: CalibrationSet, count: int, seed: int) -> CalibrationSet:
    """Draw ``count`` frames by ``seed``, scene by scene without replacement."""
    if count < 1:
        raise FramesError(f"{count} frames were asked for; at least 1 is needed")
    # Scenes stay complete, since recurrent state grows along them; only the last one
    # drawn is cut at its end. A shorter recording is taken whole: no frame counts twice
    ends = [*whole.scenes, len(whole)]
    scenes = [range(start, end) for start, end in itertools.pairwise(ends)]
    order = np.random.default_rng(seed).permutation(len(scenes)).tolist()
    drawn = [place for at in order for place in scenes[at]]
    return whole.part(sorted(drawn[:count]))


def spread(whole: CalibrationSet, count: int, run: int = 1) -> CalibrationSet:
    """Pick frames at equal distances, in runs, so that all of a recording is seen."""
    frames, picked = len(whole), set[int]()
    ends, count = [*whole.scenes, frames], min(count, frames)
    # A run is of one scene: a state grows along it
    for part in range(parts := max(1, count // run)):
        # a run in the middle of its part, and within a scene that is long enough
        length = count // parts + (part < count % parts)
        start = ((2 * part + 1) * frames // parts - length + 1) // 2
        at = bisect.bisect_right(ends, start)
        start = max(ends[at - 1], min(start, ends[at] - length))
        picked.update(range(start, start + length))
    return whole.part(sorted(whole.places[place] for place in picked))


def hold_out(
    whole: CalibrationSet, most: int, run: int = 1
) -> tuple[CalibrationSet, CalibrationSet]:
    """Split a recording: frames to calibrate on, and frames to measure on."""
    if len(whole) == 1:
        # One frame is both
        return whole, whole
    # A third of the frames is for measuring
    measured = spread(whole, max(1, min(most, -(-len(whole) // 3))), run)
    return whole.part(sorted(set(whole.places) - set(measured.places))), measured
