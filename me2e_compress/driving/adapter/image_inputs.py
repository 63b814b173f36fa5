"""One image input of a graph: its cameras, crops, layout and normalisation."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, Self, TypeAlias, get_args

import numpy as np
import numpy.typing as npt
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from me2e_compress.base import documents
from me2e_compress.base.errors import EvaluationError
from me2e_compress.base.extras import with_install_hint
from me2e_compress.driving.contract import DEFAULT_IMAGE_SIZE, Shape, fits
from me2e_compress.runtime.frames import Array

IMAGE = "me2e.image"  # metadata key: JSON of `ImageNormalization`

CameraName = Literal[
    "FRONT", "FRONT_LEFT", "FRONT_RIGHT", "BACK", "BACK_LEFT", "BACK_RIGHT"
]
# In the order of `Observation.images`
CAMERA_NAMES: tuple[CameraName, ...] = get_args(CameraName)

Side: TypeAlias = Annotated[int, Field(ge=1, le=8192)]
Size: TypeAlias = tuple[Side, Side]
Crop: TypeAlias = tuple[int, int, int, int]
Triple: TypeAlias = tuple[float, float, float]
Bytes = npt.NDArray[np.uint8]


def _divides(std: Triple) -> Triple:
    if not all(std):
        raise ValueError("std is zero")
    return std


Divisors: TypeAlias = Annotated[Triple, AfterValidator(_divides)]


class ImageNormalization(BaseModel):
    """How pixels become an image input: (scale * pixel - mean) / std, by channel."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    input: str = "img"  # name of the image input
    mean: Triple  # in grey levels 0 to 255 (times scale), channels as in order
    std: Divisors
    order: Literal["rgb", "bgr"]  # channels of the model
    scale: float = Field(default=1.0, gt=0.0)  # factor on pixels before mean and std

    @classmethod
    def of(cls, metadata: Mapping[str, str]) -> Self:
        """Read it from a model's metadata."""
        text = metadata.get(IMAGE)
        if text is None:
            raise EvaluationError(
                f"image normalisation unknown: the model has no metadata {IMAGE} and "
                f"the adapter no [image]"
            )
        try:
            return cls.model_validate(documents.from_json(text))
        except (documents.MalformedError, ValidationError) as error:
            line = " ".join(str(error).split())
            raise EvaluationError(f"metadata {IMAGE} is malformed: {line}") from error

    def apply(self, images: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
        """Return float32 [1, n, 3, H, W] of uint8 RGB [n, H, W, 3]."""
        planes = np.moveaxis(images, -1, 1)
        if self.order == "bgr":
            planes = planes[:, ::-1]
        # Reordering bytes and then converting is six times faster than both at once.
        ready = np.ascontiguousarray(planes).astype(np.float32)
        ready -= np.array(self.mean, np.float32)[:, None, None] / np.float32(self.scale)
        ready /= np.array(self.std, np.float32)[:, None, None] / np.float32(self.scale)
        return ready[None]


class ImageInput(BaseModel):
    """What an image input shows; what is left out follows from the graph."""

    # Sizes are rows and columns
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    # Names of the cameras, in the model's order
    cameras: tuple[CameraName, ...] = Field(default=CAMERA_NAMES, min_length=1)
    camera_size: Size | None = None  # of a camera's picture, in which `crop` counts
    rendered: Size | None = None  # of the pictures as they are rendered, if not that
    # Left, top, right and bottom of each camera, or of one for all; None takes whole
    # pictures
    crop: tuple[Crop, ...] | None = None
    stitch: bool = False  # join the cameras, from left to right, into one picture
    # To which the result is resized, bilinearly; in a larger input the rest, below and
    # to the right, is zero
    size: Size | None = None
    # Letters of the dimensions: batch, n cameras, channels, h rows, w columns
    layout: str | None = None
    # Normalisation; by default that of the adapter's [image] or the model's metadata.
    # An input of uint8 takes none.
    mean: Triple | None = None
    std: Divisors | None = None
    scale: float = Field(default=1.0, gt=0.0)
    order: Literal["rgb", "bgr"] | None = None

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if (self.mean is None) != (self.std is None):
            raise ValueError("mean and std belong together")
        # The layout has c, h and w, and every letter once
        letters = "chw" if self.layout is None else self.layout
        known = set("chw") <= set(letters) <= set("bnchw")
        if not known or len(set(letters)) != len(letters):
            raise ValueError(
                f"layout {letters!r} must be the letters c, h and w, with b and n if "
                "there are such dimensions"
            )
        # Crops lie in the picture of which they count pixels, one for each camera
        if self.crop is not None:
            if self.camera_size is None:
                raise ValueError("crop needs the camera_size whose pixels it counts")
            rows, columns = self.camera_size
            crops = self.crops or ()
            if len(crops) != len(self.cameras):
                raise ValueError(f"{len(crops)} crops for {len(self.cameras)} cameras")
            for left, top, right, bottom in crops:
                if not (0 <= left < right <= columns and 0 <= top < bottom <= rows):
                    crop = [left, top, right, bottom]
                    place = f"{rows} rows of {columns} columns"
                    raise ValueError(f"crop {crop} does not lie in {place}")
        return self

    @property
    def crops(self) -> tuple[Crop, ...] | None:
        """The crop of each camera."""
        if self.crop is None or len(self.crop) > 1:
            return self.crop
        return self.crop * len(self.cameras)

    def normalization(
        self, name: str, otherwise: ImageNormalization | None
    ) -> ImageNormalization | None:
        """Return this table's own normalisation, or else another with its order."""
        if self.mean is not None and self.std is not None:
            order = self.order or "rgb"
            return ImageNormalization(
                input=name, mean=self.mean, std=self.std, order=order, scale=self.scale
            )
        if otherwise is None or self.order is None:
            return otherwise
        return otherwise.model_copy(update={"order": self.order})


@dataclass(frozen=True)
class ImagePort:
    """The layout of an image input of a graph, and its size."""

    layout: str
    size: tuple[int, int]  # rows and columns, by default the usual ones

    @classmethod
    def of(cls, name: str, shape: Shape, table: ImageInput) -> Self:
        """Read a port's shape."""
        # Without a layout in the table, the rank of the shape tells it
        pictures = 1 if table.stitch else len(table.cameras)
        single = {5: "bnchw", 4: "bchw", 3: "chw"}
        several = {5: "bnchw", 4: "nchw"}
        usual = (single if pictures == 1 else several).get(len(shape), "bnchw")
        layout = table.layout or usual
        known = {"b": 1, "n": pictures, "c": 3}
        wanted = tuple(known.get(letter, "any") for letter in layout)
        if not fits(shape, wanted) or ("n" not in layout and pictures > 1):
            problem = f"input {name} has shape {list(shape)}, it must be "
            if table == ImageInput():
                raise EvaluationError(
                    f"{problem}[1, 6, 3, 'any', 'any'], or [images.{name}] say which"
                    " cameras it shows"
                )
            raise EvaluationError(f"{problem}{list(wanted)}")
        # Open sides take the table's size, or the default
        sides = zip("hw", table.size or DEFAULT_IMAGE_SIZE, strict=True)
        fixed = {letter: shape[layout.index(letter)] for letter in "hw"}
        rows, columns = (
            side if isinstance(side := fixed[letter], int) else default
            for letter, default in sides
        )
        return cls(layout, (rows, columns))


def rendered_size(name: str, table: ImageInput, port: ImagePort) -> tuple[int, int]:
    """Return rows and columns that an image input wants its cameras rendered in."""
    rows, columns = table.size or port.size
    if rows > port.size[0] or columns > port.size[1]:
        raise EvaluationError(
            f"input {name} has {port.size[0]} rows and {port.size[1]} columns: a size "
            f"of {rows} x {columns} does not fit"
        )
    # Without stitching, the cameras are rendered as the input is
    own = table.rendered or table.camera_size
    if own is not None or not table.stitch:
        return own or (rows, columns)
    # Stitched cameras share the columns
    if columns % len(table.cameras):
        raise EvaluationError(
            f"input {name}: {columns} columns of {len(table.cameras)} cameras: "
            "camera_size must say what one of them has"
        )
    return rows, columns // len(table.cameras)


# Convert camera pictures to the images that a graph takes.


@dataclass(frozen=True, eq=False)
class InputImages:
    """Makes one image input from the cameras' pictures."""

    table: ImageInput
    port: ImagePort
    rendered: tuple[int, int]  # rows and columns of the cameras' pictures
    normalization: ImageNormalization | None  # None leaves bytes

    @property
    def indices(self) -> tuple[int, ...]:
        """Indices of the cameras among the six."""
        return tuple(map(CAMERA_NAMES.index, self.table.cameras))

    @property
    def windows(self) -> tuple[Crop, ...]:
        """Left, top, right and bottom of each crop, in rendered pixels."""
        rows, columns = self.rendered
        if (crops := self.table.crops) is None:
            return ((0, 0, columns, rows),) * len(self.indices)
        # Crops count pixels of the camera's own size
        full_rows, full_columns = self.table.camera_size or self.rendered
        across, down = columns / full_columns, rows / full_rows
        windows = list[Crop]()
        for left, top, right, bottom in crops:
            begin = round(left * across), round(top * down)
            windows.append((*begin, round(right * across), round(bottom * down)))
        return tuple(windows)

    def check(self, name: str) -> None:
        """Check that no crop is empty, and that crops to stitch have one height."""
        rows, columns = self.rendered
        problem = f"input {name}: of cameras rendered in {rows} x {columns}"
        if not all(a < c and b < d for a, b, c, d in self.windows):
            raise EvaluationError(f"{problem}, a crop has no pixel")
        heights = sorted({bottom - top for _, top, _, bottom in self.windows})
        if self.table.stitch and len(heights) > 1:
            raise EvaluationError(
                f"{problem}, the crops that are stitched have {heights[0]} and"
                f" {heights[-1]} rows: choose crops or a rendered size that divide"
            )

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of a picture, without padding."""
        return self.table.size or self.port.size

    def apply(self, images: Bytes) -> Array:
        """Return the input in the graph's layout, from uint8 RGB [6, H, W, 3]."""
        pictures = self._pictures(images)
        if self.normalization is None:
            planes: Array = np.moveaxis(pictures, -1, 1)
            planes = planes[:, ::-1] if self.table.order == "bgr" else planes
        else:
            planes = self.normalization.apply(pictures)[0]
        # Put zeros below and to the right of pictures that are smaller than the input
        height, width = planes.shape[-2:]
        if (height, width) != self.port.size:
            padded = np.zeros((*planes.shape[:2], *self.port.size), planes.dtype)
            padded[..., :height, :width] = planes
            planes = padded
        # Bring [n, c, h, w] into the graph's layout
        letters, layout = "nchw", self.port.layout
        if "n" not in layout:
            planes, letters = planes[0], "chw"
        order = [letters.index(letter) for letter in layout if letter != "b"]
        turned = planes.transpose(order)
        if "b" in layout:
            turned = np.expand_dims(turned, layout.index("b"))
        return np.ascontiguousarray(turned)

    def projections(
        self, lidar2img: npt.NDArray[np.float32]
    ) -> npt.NDArray[np.float32]:
        """Convert [6, 4, 4] to rendered pixels into [cameras, 4, 4] to this input's."""
        chosen = lidar2img[list(self.indices)]
        # From rendered pixels of a camera to those of this input: move, then scale
        widths = [right - left for left, _, right, _ in self.windows]
        moves = np.tile(np.eye(4), (len(widths), 1, 1))  # (cameras, 4, 4)
        for at, (left, top, _, bottom) in enumerate(self.windows):
            # Stitched cameras follow each other in one picture
            before = sum(widths[:at]) if self.table.stitch else 0
            across = self.size[1] / (sum(widths) if self.table.stitch else widths[at])
            down = self.size[0] / (bottom - top)
            moves[at, 0, 0], moves[at, 1, 1] = across, down
            moves[at, 0, 2], moves[at, 1, 2] = across * (before - left), -down * top
        if np.array_equal(moves, np.broadcast_to(np.eye(4), moves.shape)):
            return chosen
        return np.asarray(moves @ chosen, np.float32)

    def _pictures(self, images: Bytes) -> Bytes:
        """Crop, stitch and resize: return uint8 RGB [pictures, h, w, 3]."""
        # Crop and stitch
        cameras = zip(self.indices, self.windows, strict=True)
        parts = [images[i, top:bottom, a:b] for i, (a, top, b, bottom) in cameras]
        if self.table.stitch:
            parts = [np.concatenate(parts, axis=1)]
        if all(part.shape[:2] == self.size for part in parts):
            return np.stack(parts)
        # Resize bilinearly, by pixel centres; a picture of that size stays as it is
        try:
            import cv2
        except ImportError as error:
            raise with_install_hint(error) from error
        size, how = self.size[::-1], cv2.INTER_LINEAR
        resized = [cv2.resize(part, size, interpolation=how) for part in parts]
        return np.stack(resized).astype(np.uint8, copy=False)
