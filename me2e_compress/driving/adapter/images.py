"""Normalisation of a model's image input."""

from collections.abc import Mapping
from typing import Literal, Self, TypeAlias

import numpy as np
import numpy.typing as npt
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
)

from me2e_compress import documents
from me2e_compress.errors import EvaluationError

IMAGE = "me2e.image"
"""Metadata key: JSON of `ImageNormalization`."""

Triple: TypeAlias = tuple[float, float, float]


class ImageNormalization(BaseModel):
    """How pixels become an image input: (scale * pixel - mean) / std, by channel.

    Attributes:
        input: Name of the image input.
        mean: In grey levels 0 to 255 (times `scale`), in the order of `order`.
        std: Like mean.
        order: Channels of the model: red first or blue first.
        scale: Factor on pixels before mean and std.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    input: str = "img"
    mean: Triple
    std: Triple
    order: Literal["rgb", "bgr"]
    scale: float = Field(default=1.0, gt=0.0)

    @field_validator("std")
    @classmethod
    def _divides(cls, std: Triple) -> Triple:
        if not all(std):
            raise ValueError("std is zero")
        return std

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
