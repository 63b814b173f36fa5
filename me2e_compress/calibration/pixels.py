"""Images in recordings: bytes on disk, normalised when they are fed.

A frame of six 1600 x 928 images has 107 MB as float32 and 27 MB as bytes. A recording
lists the inputs stored as bytes in ``scenes.json``:
``{"pixels": {"version": 1, "inputs": {"img": {"mean": ..., "std": ..., ...}}}}``.
Other inputs are fed unchanged. A reader that does not know the key refuses the bytes,
since their type and shape do not fit the model.
"""

from collections.abc import Mapping
from typing import Annotated, Literal, Self, TypeAlias

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, PositiveInt

from me2e_compress.calibration.archives import Declared
from me2e_compress.runtime.frames import Array

Triple: TypeAlias = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
Spread: TypeAlias = Annotated[FiniteFloat, Field(gt=0)]

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

    mean: Triple
    std: tuple[Spread, Spread, Spread]
    order: Literal["rgb", "bgr"]
    rows: PositiveInt
    columns: PositiveInt

    def fed(self, stored: Declared) -> Declared:
        """Return shape and type of a stored input when it is fed.

        Raises:
            ValueError: it is not bytes, has not three planes, or is too large.
        """
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
        return Declared(shape, np.dtype(np.float32))

    def normalised(self, stored: Array) -> npt.NDArray[np.float32]:
        """Return the input, float32 [..., 3, rows, columns]; errors as :meth:`fed`."""
        shape = self.fed(Declared(stored.shape, stored.dtype)).shape
        height, width = stored.shape[-2:]
        ready = np.zeros(shape, np.float32)
        picture = ready[..., :height, :width]
        picture[...] = stored
        picture -= np.array(self.mean, np.float32)[:, None, None]
        picture /= np.array(self.std, np.float32)[:, None, None]
        return ready


class PixelInputs(BaseModel):
    """The entry ``pixels`` of ``scenes.json``.

    Attributes:
        version: version of this format; later ones are refused.
        inputs: the inputs stored as bytes, by name.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    version: Literal[1] = 1
    inputs: dict[str, PixelInput] = {}

    @classmethod
    def of(cls, index: Mapping[str, object]) -> Self:
        """Read the entry from the content of ``scenes.json``; old ones have none."""
        found = index.get("pixels")
        return cls() if found is None else cls.model_validate(found)
